"""How a request finds its replica, as Envoy 1.3x does it. What Envoy counts as load are open requests: a stream is one.

Hashes are random numbers here, drawn from the number of the replica or the scene: what a good hash gives.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .workload import Floats, Integers

MAGLEV_TABLE = 65_537  # Envoy's default


class OpenRequests:
    """What one Envoy has open at the replicas of one cluster."""

    def __init__(self, replicas: int) -> None:
        self.of: list[int] = [0] * replicas
        self.total = 0


class Balancer(Protocol):
    """One cluster of an Envoy."""

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        """The number of the replica."""


@dataclass(frozen=True)
class Replicas:
    """Those that are alive, in the order in which Envoy has them."""

    numbers: Sequence[int]
    weights: Floats  # [R], sum 1

    @classmethod
    def equal(cls, numbers: Sequence[int]) -> Replicas:
        return cls(numbers, np.full(len(numbers), 1.0 / len(numbers)))


class Random:
    """Any replica."""

    def __init__(self, replicas: Replicas, seed: int) -> None:
        self._numbers = list(replicas.numbers)
        self._random = random.Random(seed)

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        return self._numbers[int(self._random.random() * len(self._numbers))]


class LeastRequest:
    """Of two random replicas the one with fewer open requests: Envoy's `least_request` with its defaults."""

    def __init__(self, replicas: Replicas, seed: int) -> None:
        self._numbers = list(replicas.numbers)
        self._random = random.Random(seed)

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        numbers, draw, count = self._numbers, self._random.random, len(self._numbers)
        one, other = numbers[int(draw() * count)], numbers[int(draw() * count)]
        return other if open_requests.of[other] < open_requests.of[one] else one


class Hashed:
    """The home of a scene, or one of its homes where it has several keys."""

    def __init__(self, homes: Integers, seed: int) -> None:  # homes [keys, scenes]
        self.homes = homes
        self._homes: list[list[int]] = homes.tolist()
        self._random = random.Random(seed)

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        homes = self._homes
        return homes[int(self._random.random() * len(homes)) if len(homes) > 1 else 0][scene]


class BoundedLoad:
    """The home of a scene, unless it has more open requests than its share, which is `factor` per cent of the mean.

    Then it is the first replica below its share in an order that depends on the scene alone.

    Envoy does not take the next on the ring: it shuffles all replicas by the hash of the key, so that the scenes of a
    full replica spread over all others.
    """

    def __init__(self, hashed: Hashed, replicas: Replicas, factor: int, seed: int) -> None:
        if factor <= 100:
            raise ValueError(f"factor must be above 100 per cent, got {factor}")
        self._hashed = hashed
        self._factor = factor
        self._numbers = list(replicas.numbers)
        weights, kinds = np.unique(replicas.weights, return_inverse=True)  # few: a share is computed once for each
        self._weights: list[float] = weights.tolist()
        self._kind = dict(zip(replicas.numbers, kinds.tolist(), strict=True))
        self._seed = seed
        self._orders: dict[int, _Order] = {}

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        slots = ((open_requests.total + 1) * self._factor + 99) // 100
        shares = [max(1, math.ceil(slots * weight)) for weight in self._weights]
        opened, kind = open_requests.of, self._kind
        home = self._hashed.choose(scene, open_requests)
        if opened[home] <= shares[kind[home]]:
            return home
        if (order := self._orders.get(scene)) is None:
            order = self._orders[scene] = _Order(self._numbers, self._seed * 2**32 + scene)
        for replica in order.drawn:
            if opened[replica] <= shares[kind[replica]]:
                return replica
        while opened[replica := order.draw()] > shares[kind[replica]]:
            pass  # ends: all shares together are more than all open requests
        return replica


class _Order:
    """A shuffle of the replicas that is made as far as it is needed.

    Each draw is scaled to the number of replicas, as in Envoy: where one joins or leaves, the order changes in part.
    """

    def __init__(self, numbers: Sequence[int], seed: int) -> None:
        self.drawn: list[int] = []
        self._numbers = list(numbers)
        self._random = random.Random(seed)

    def draw(self) -> int:
        """The next replica."""
        numbers, first = self._numbers, len(self.drawn)
        other = first + int(self._random.random() * (len(numbers) - first))
        numbers[first], numbers[other] = numbers[other], numbers[first]
        self.drawn.append(numbers[first])
        return numbers[first]


@dataclass(frozen=True)
class Hashes:
    """Numbers in [0, 1) in place of hashes. `port` tells those of replicas in one cluster from those in another."""

    seed: int
    port: int = 0

    def of_scenes(self, scenes: int, keys: int) -> Floats:  # [keys, scenes]
        """The hash of each key of each scene."""
        return np.random.default_rng((self.seed, 0)).random((keys, scenes))

    def of_replica(self, number: int, count: int) -> Floats:  # [count]
        """The first hashes of a replica: the same however many are asked for."""
        return np.random.default_rng((self.seed, 1, self.port, number)).random(count)


def ring_homes(replicas: Replicas, hashes: Hashes, scenes: int, keys: int, minimum_size: int) -> Integers:
    """The homes [keys, scenes] on a ring of at least `minimum_size` points, as many for each as its weight says."""
    smallest = float(replicas.weights.min())
    size = math.ceil(smallest * minimum_size) / smallest
    counts = np.diff(np.ceil(np.cumsum(replicas.weights) * size - 1e-6), prepend=0.0).astype(np.int64)
    points = np.concatenate(
        [hashes.of_replica(number, int(count)) for number, count in zip(replicas.numbers, counts, strict=True)]
    )
    order = np.argsort(points)
    owners = np.repeat(np.asarray(replicas.numbers), counts)[order]
    return np.asarray(owners[np.searchsorted(points[order], hashes.of_scenes(scenes, keys)) % len(owners)])


def maglev_homes(replicas: Replicas, hashes: Hashes, scenes: int, keys: int) -> Integers:
    """The homes [keys, scenes] in a Maglev table, in which all replicas have the same weight."""
    table = [-1] * MAGLEV_TABLE
    places, steps = [], []
    for number in replicas.numbers:
        first, second = hashes.of_replica(number, 2)
        places.append(int(first * MAGLEV_TABLE))
        steps.append(1 + int(second * (MAGLEV_TABLE - 1)))
    for turn in range(MAGLEV_TABLE):
        index = turn % len(places)
        place = places[index]
        while table[place] >= 0:
            place = (place + steps[index]) % MAGLEV_TABLE
        table[place] = replicas.numbers[index]
        places[index] = place
    return np.asarray(np.array(table)[(hashes.of_scenes(scenes, keys) * MAGLEV_TABLE).astype(np.int64)])
