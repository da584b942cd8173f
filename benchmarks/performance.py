"""Writes what `make bench` measured into README.md and pages of docs: `python benchmarks/performance.py`.

Each place stands between `<!-- measured: NAME -->` and `<!-- end -->`; BLOCKS says what is written there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

FOLDER = Path(__file__).resolve().parent
DOCUMENTS = tuple(FOLDER.parent / page for page in ("README.md", "docs/performance.md", "docs/howto/robotics.md"))
_MEASURED = re.compile(r"(?<=<!-- measured: )([\w ,-]+?)( -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)

Measured: TypeAlias = dict[str, Any]
Lines: TypeAlias = Iterable[str]


def current(document: str, folder: Path = FOLDER) -> str:
    """The document with the figures that the files of `folder` hold."""
    return _MEASURED.sub(lambda match: f"{match[1]}{match[2]}{_written(match[1], folder)}", document)


def _written(block: str, folder: Path) -> str:
    file, write = BLOCKS[block]
    measured = json.loads((folder / file).read_text(encoding="utf-8"))
    return "".join(f"{line}\n" for line in (*write(measured), "", _origin(measured, file)))


def _origin(measured: Measured, file: str) -> str:
    machine = measured["machine"]
    return (
        f"`benchmarks/{file}`, commit {machine['commit']}, {machine['measured_at'][:10]}: {machine['processor']}, "
        f"{machine['instruction_set']}, {machine['threads']} threads."
    )


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    names = list(head)
    yield f"| {' | '.join(names)} |"
    yield "|---" * len(names) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def frames(measured: Measured) -> Lines:
    """The kernel and the front doors, and the memory of a worker process."""
    rows = (
        (
            row["what"],
            f"{row['gaussians']:,}",
            str(row["threads"]),
            str(row["poses"]),
            f"{row['p50_ms']:.2f}",
            f"{row['p99_ms']:.2f}",
            f"{row['frames_per_s']:.0f}",
            "" if row["above_kernel_ms"] is None else f"{row['above_kernel_ms']:.2f}",
        )
        for row in measured["rows"]
    )
    head = ("What", "Gaussians", "Threads", "Poses at once", "p50 ms", "p99 ms", "Frames/s", "Above kernel ms")
    yield from _table(head, rows)
    memory = ", ".join(f"{int(count):,} Gaussians {mb:.0f} MB" for count, mb in measured["worker_memory_mb"].items())
    yield ""
    yield f"Memory of a worker process: with {memory}."


def frames_at_a_glance(measured: Measured) -> Lines:
    """What a reader of the README wants to know: the kernel and each front door, p50 and p99 by number of Gaussians."""
    names = {
        ("kernel", 1): "the kernel alone, 1 thread",
        ("kernel", 2): "the kernel alone, 2 threads",
        ("gRPC stream", 2): "gRPC stream, to the client",
        ("HTTP raw", 2): "HTTP, raw pixels, to the client",
        ("HTTP PNG", 2): "HTTP, PNG, to the client",
    }
    of = {(row["what"], row["threads"], row["gaussians"]): row for row in measured["rows"] if row["poses"] == 1}
    counts = sorted({row["gaussians"] for row in measured["rows"]}, reverse=True)
    return _table(
        ("Median / 99th percentile", *(f"{count:,} Gaussians" for count in counts)),
        (
            (name, *(f"{of[(*key, count)]['p50_ms']:.1f} / {of[(*key, count)]['p99_ms']:.1f} ms" for count in counts))
            for key, name in names.items()
        ),
    )


def steps(measured: Measured) -> Lines:
    """Training steps and the shares of their parts."""
    return _table(
        ("Gaussians", "Images", "Threads", "Step ms", "Forward", "Loss", "Backward", "Optimizer"),
        (
            (
                f"{row['gaussians']:,}",
                row["images"],
                str(row["threads"]),
                f"{row['step_ms']:.1f}",
                *(f"{share:.0%}" for share in row["shares"].values()),
            )
            for row in measured["rows"]
        ),
    )


def parts(measured: Measured) -> Lines:
    """The parts of a frame in the kernel, and its work."""
    cores = list(measured["rows"][0]["modelled_speedups"])
    return _table(
        (
            *("Scene", "Instructions", "Frame ms", "Slicing", "Drawing", "Finishing", "Slices", "Groups", "Rows"),
            *("Lanes used", "ns a row", "MB moved", f"Modelled on {', '.join(cores)} cores"),
        ),
        (
            (
                row["what"],
                row["instruction_set"],
                *(f"{row[f'{part}_ms']:.2f}" for part in ("frame", "slicing", "drawing", "finishing")),
                *(f"{row[what]:,.0f}" for what in ("slices", "groups", "rows")),
                f"{row['lanes_used']:.0%}",
                f"{row['ns_per_row']:.1f}",
                f"{row['megabytes_moved']:.0f}",
                ", ".join(f"{speedup:.1f}" for speedup in row["modelled_speedups"].values()),
            )
            for row in measured["rows"]
        ),
    )


def clients(measured: Measured) -> Lines:
    """What each kind of client gets."""
    extent, by_client = measured["extent"], measured["clients"]
    loop, igtl, batch = (by_client[name] for name in ("control loop", "OpenIGTLink", "augmentation"))
    pages = {name: one for name, one in by_client.items() if name.startswith("WebSocket")}
    yield from _table(
        ("Client", "Measured"),
        (
            (
                f"Control loop, gRPC stream at 60 Hz for {extent['loop_s']:.0f} s, mode `latest`",
                f"p50 {loop['p50_ms']:.1f}, p99 {loop['p99_ms']:.1f}, p99.9 {loop['p99.9_ms']:.1f} ms; jitter "
                f"{loop['jitter_ms']:.1f} ms; {loop['dropped']:.0f} of its poses dropped",
            ),
            *(
                (name, f"{one['frames_per_s']:.0f} frames/s, to each at least {one['least_frames_per_s']:.0f}")
                for name, one in pages.items()
            ),
            ("OpenIGTLink, one pose after another", f"p50 {igtl['p50_ms']:.1f}, p99 {igtl['p99_ms']:.1f} ms"),
            (
                f"Augmentation: a job of {extent['frames']:,} frames, 8 bit, to npz, {extent['gaussians']:,} random "
                "Gaussians",
                f"{batch['frames_per_s']:.0f} frames/s; the kernel by itself {batch['kernel_frames_per_s']:.0f}: "
                f"{batch['share_of_kernel']:.0%}",
            ),
        ),
    )


def control_loop(measured: Measured) -> Lines:
    """What a robot waits for."""
    loop = measured["clients"]["control loop"]
    return _table(
        ("From sending a pose to having its frame", "ms"),
        (
            ("median", f"{loop['p50_ms']:.1f}"),
            ("99 of 100 frames", f"{loop['p99_ms']:.1f}"),
            ("999 of 1,000 frames", f"{loop['p99.9_ms']:.1f}"),
            ("time between two frames, standard deviation", f"{loop['jitter_ms']:.1f}"),
        ),
    )


def jobs(measured: Measured) -> Lines:
    """A service with a long list of jobs."""
    return _table(
        ("What", "p50 ms", "p99 ms"),
        ((what, f"{of['p50']:.1f}", f"{of['p99']:.1f}") for what, of in measured["latency_ms"].items()),
    )


BLOCKS: dict[str, tuple[str, Callable[[Measured], Lines]]] = {
    "frames": ("results.json", frames),
    "frames at a glance": ("results.json", frames_at_a_glance),
    "training steps": ("training.json", steps),
    "parts of a frame": ("kernel.json", parts),
    "clients": ("clients.json", clients),
    "control loop": ("clients.json", control_loop),
    "jobs": ("jobs.json", jobs),
}


def main() -> None:
    """Rewrite the documents."""
    for document in DOCUMENTS:
        document.write_text(current(document.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
