"""What is compared: every table of docs/scaling.md with its rows. What a row does not name is as DEFAULTS has it.

The policies are compared at full size. All else is compared in a quarter of it: as many replicas, clients, scenes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from .caches import CacheSizes
from .costs import Storage
from .defaults import DEFAULTS
from .routing import Change
from .study import SETTLING_S, Case, Policy
from .workload import Workload

MIB, GIB = 2**20, 2**30
EXPONENTS = (0.8, 1.0, 1.2)
POLICIES = {
    "random": Policy("random"),
    "least request": Policy("least request"),
    "ring hash": Policy(factor=None),
    f"ring hash, {DEFAULTS.hash_balance_factor}%": Policy(),
    f"Maglev, {DEFAULTS.hash_balance_factor}%": Policy("Maglev"),
}
QUARTER = Case(replicas=250, workload=Workload(clients=25_000, scenes=2_500))
FAST, FASTER = 50, 5.0  # as much capacity in so many replicas that are so much faster
DYING, JOINING = range(0, 250, 20), range(250, 263)  # one in twenty, and as many others
CHANGES = (Change(SETTLING_S + 2.0, die=DYING), Change(SETTLING_S + 8.0, join=JOINING))
CHANGING_S = 16.0
UNEQUAL = (0.5, 1.5)  # speeds


def _with(policy: Policy) -> Case:
    return replace(QUARTER, policy=policy)


def _with_streams(count: int) -> Case:
    """`count` of a thousand clients have a stream."""
    return replace(QUARTER, workload=replace(QUARTER.workload, streaming_share=count / 1000.0))


def _with_memory(size: int) -> Case:
    return replace(QUARTER, sizes=CacheSizes(memory=size))


STUDIES: Mapping[str, Mapping[str, Case]] = {
    "policies": {name: Case(policy) for name, policy in POLICIES.items()},
    "exponents": {
        f"{name}; {exponent}": replace(QUARTER, policy=policy, workload=replace(QUARTER.workload, exponent=exponent))
        for exponent in EXPONENTS
        for name, policy in POLICIES.items()
    },
    "factors": {
        "none": _with(Policy(factor=None)),
        **{f"{factor}%": _with(Policy(factor=factor)) for factor in (101, 110, 125, 150, 200)},
    },
    "rings": {
        "2 a replica, no bound": _with(Policy(factor=None, ring_size=500)),
        "263 a replica, no bound": _with(Policy(factor=None)),
        "2 a replica": _with(Policy(ring_size=500)),
        "263 a replica": QUARTER,
    },
    "doors": {
        "with the port of the door": QUARTER,
        "without ports": _with(Policy(one_home=True)),
        "with the port, all streams by gRPC": replace(QUARTER, workload=replace(QUARTER.workload, websocket_share=0.0)),
    },
    "hot scenes": {
        "1": QUARTER,
        "2": _with(Policy(keys=2)),
        "8": _with(Policy(keys=8)),
        "8, no bound": _with(Policy(keys=8, factor=None)),
    },
    "proxies": {f"{count}": replace(QUARTER, proxies=count) for count in (1, 2, 4, 16)},
    "caches": {
        **{f"{size // MIB:,} MiB": _with_memory(size) for size in (GIB // 4, GIB // 2, GIB, 4 * GIB)},
        "4,096 MiB, random": _with(Policy("random")),
        "4,096 MiB, slower storage": replace(QUARTER, storage=Storage(first_byte_s=0.2, bytes_per_s=25e6)),
    },
    "load": {
        **{f"{count / 10:g}": _with_streams(count) for count in (20, 30, 40, 50, 60, 70, 80)},
        **{
            f"{count / 10 * FASTER:g}, {FASTER:g} times as fast": replace(
                _with_streams(count), replicas=FAST, speeds=(FASTER,)
            )
            for count in (50, 60, 70)
        },
    },
    "changes": {
        "none": replace(QUARTER, measured_s=CHANGING_S),
        **{
            name: replace(_with(policy), changes=CHANGES, measured_s=CHANGING_S)
            for name, policy in POLICIES.items()
            if name not in ("least request", "ring hash")
        },
    },
    "speeds": {
        "random": replace(_with(Policy("random")), speeds=UNEQUAL),
        "least request": replace(_with(Policy("least request")), speeds=UNEQUAL),
        "ring hash with a bound, all the same weight": replace(_with(Policy(weighted=False)), speeds=UNEQUAL),
        "ring hash with a bound, weights as speeds": replace(QUARTER, speeds=UNEQUAL),
    },
}
