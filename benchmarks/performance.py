"""The tables of what `ultragray bench`, `make bench-console` and `make libraries` measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from registry import Document


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    names = list(head)
    yield f"| {' | '.join(names)} |"
    yield "|---" * len(names) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def frames(measured: Document) -> Iterator[str]:
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


def frames_at_a_glance(measured: Document) -> Iterator[str]:
    """What a reader of the README wants to know: the kernel and each front door, p50 and p99 by number of Gaussians."""
    names = {
        ("kernel", 1): "renderer, 1 thread",
        ("kernel", 2): "renderer, 2 threads",
        ("gRPC stream", 2): "to a client over a gRPC stream",
        ("HTTP raw", 2): "to a client over HTTP, raw pixels",
        ("HTTP PNG", 2): "to a client over HTTP, PNG",
    }
    of = {(row["what"], row["threads"], row["gaussians"]): row for row in measured["rows"] if row["poses"] == 1}
    counts = sorted({row["gaussians"] for row in measured["rows"]}, reverse=True)
    yield from _table(
        ("Median / 99th percentile", *(f"{count:,} Gaussians" for count in counts)),
        (
            (name, *(f"{of[(*key, count)]['p50_ms']:.1f} / {of[(*key, count)]['p99_ms']:.1f} ms" for count in counts))
            for key, name in names.items()
        ),
    )


def steps(measured: Document) -> Iterator[str]:
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


def parts(measured: Document) -> Iterator[str]:
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


def clients(measured: Document) -> Iterator[str]:
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


def control_loop(measured: Document) -> Iterator[str]:
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


def shards(measured: Document) -> Iterator[str]:
    """A batch on the queue and on Ray, beside the kernel."""
    extent, kernel = measured["extent"], measured["kernel_frames_per_s"]
    workers = extent["workers"]
    rows = [(f"kernel alone, {workers} processes of one thread", f"{kernel:,.0f}", "", "")]
    for engine, name in (("queue", "queue"), ("ray", "Ray")):
        if (found := measured.get(engine)) is not None:
            share = f"{found['share_of_kernel']:.0%}"
            rows.append((f"{name}, {workers} workers", f"{found['frames_per_s']:,.0f}", share, str(found["kills"])))
    what = f"{extent['frames']:,} frames of {extent['side']}x{extent['side']}, {extent['shards']} shards"
    return _table((what, "Frames/s", "Of the kernel", "Killed in the second half"), rows)


def jobs(measured: Document) -> Iterator[str]:
    """A service with a long list of jobs."""
    return _table(
        ("What", "p50 ms", "p99 ms"),
        ((what, f"{of['p50']:.1f}", f"{of['p99']:.1f}") for what, of in measured["latency_ms"].items()),
    )


def console(measured: Document) -> Iterator[str]:
    """The console in Chromium."""
    rate, heap, click = measured["frames_per_s"], measured["heap_mib"], measured["click_in_3d_ms"]
    yield from _table(
        ("What", "Measured"),
        (
            (
                f"A sweep played at 512x512 for {measured['seconds']:.0f} s",
                f"{rate['median']:.0f} frames/s, {rate['least']:.0f} in its slowest ten seconds",
            ),
            ("Heap after a collection", f"{heap['first']:.0f} MiB at first, at most {heap['most']:.0f} MiB"),
            (
                "From a click in the 3D view until the picture shows it",
                f"{click['median']:.0f} ms, at most {click['most']:.0f} ms",
            ),
            ("First paint", f"{measured['first_contentful_paint_ms'] / 1000:.2f} s"),
            ("First image", f"{measured['first_image_ms'] / 1000:.1f} s"),
            ("Size of the page", f"{measured['bundle_gzip_kb']:.0f} KB gzipped"),
        ),
    )


def environment(measured: Document) -> Iterator[str]:
    """Steps a second of a random policy, by size and contact."""
    yield from _table(
        ["Frame", "Contact", "Steps/s", "p50 ms", "p99 ms"],
        (
            [
                f"{row['side']}x{row['side']}",
                row["contact"] or "assumed",
                f"{row['steps_per_s']:.0f}",
                f"{row['p50_ms']:.2f}",
                f"{row['p99_ms']:.2f}",
            ]
            for row in measured["rows"]
        ),
    )


def ros(measured: Document) -> Iterator[str]:
    """From a pose to its image, through the ROS 2 node and without it."""
    yield from _table(
        ["Frame", "Way", "p50 ms", "p99 ms"],
        (
            [f"{row['side']}x{row['side']}", row["way"], f"{row['p50_ms']:.1f}", f"{row['p99_ms']:.1f}"]
            for row in measured["rows"]
        ),
    )


def imports(measured: Document) -> Iterator[str]:
    """What scikit-image takes to install, and to import."""
    sizes = measured["installed_mb"]
    parts = ", ".join(f"{name} {size:.0f} MB" for name, size in sizes.items() if size >= 1.0)
    yield f"Installed: {sum(sizes.values()):.0f} MB ({parts})."
    yield ""
    yield "| Import | ms |"
    yield "|---|---|"
    for name, spent_ms in measured["import_ms"].items():
        yield f"| `{name}` | {spent_ms:.0f} |"


def beside_scikit_image(measured: Document) -> Iterator[str]:
    """The table of comparisons."""
    yield "| What | here | ms | scikit-image | ms | largest difference |"
    yield "|---|---|---|---|---|---|"
    for row in measured["rows"]:
        ours, theirs = (f"{row[f'{whose}_ms']:.2f}" for whose in ("ours", "theirs"))
        yield (
            f"| {row['what']} | {row['ours_with']} | {ours} | `{row['theirs_with']}` | {theirs} "
            f"| {row['difference']:.1g} |"
        )


def shadows(measured: Document) -> Iterator[str]:
    """The table of shadows."""
    yield "| Method | precision | recall | intersection over union | of speckle without a shadow |"
    yield "|---|---|---|---|---|"
    for row in measured["shadows"]:
        shares = (f"{row[key]:.0%}" for key in ("precision", "recall", "overlap", "of_speckle"))
        yield f"| {row['method']} | {' | '.join(shares)} |"
