"""Measured figures: one way to record them, and to write them into the documents.

    python benchmarks/figures.py ready            refuse a checkout with uncommitted changes, before hours are spent
    python benchmarks/figures.py record NAME ...  figures of this commit, from build/bench, to the place of those that
                                                  are under version control; then write the documents
    python benchmarks/figures.py show TARGET      print the tables of what a target left in build/bench
    python benchmarks/figures.py list             commit, date and machine of all figures, and the commits since
    python benchmarks/figures.py check            fail where a document does not hold what the files say

A file is JSON that begins with `measured`: commit, date, machine; or it holds runs by name, each of which begins so. In
documents, a table stands between `<!-- measured: NAME -->` and `<!-- end -->`; BLOCKS makes it.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import ablations
import compressed
import confidence
import editing
import from_labels
import hand
import live
import localization
import measuring
import methods_tables
import motion
import planning
import policy
import poses
import prediction
import pressing
import preview
import results_tables
import speckle
from measuring import Document, Lines, columns, described, heads, kept, read, staged, table
from ultragray.files import write_whole
from ultragray_studies.bench.report import DIRTY, changed_sources, commit

_PLACE = re.compile(r"(?<=<!-- measured: )([\w ,-]+?)( -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)
_SHOWN = 3  # names of changed files

# Every file of figures, with the target of the Makefile that measures it.
TARGETS = {
    **dict.fromkeys(("results", "kernel", "training", "jobs", "clients"), "bench"),
    "console": "bench-console",
    "browser": "bench-browser",
    **dict.fromkeys(("cuda", "cuda_training"), "bench-cuda"),
    "results_tables": "results",
    "methods_tables": "methods",
    **{
        name: name
        for name in (
            *("ablations", "poses", "hand", "localization", "confidence"),
            *("speckle", "environment", "prediction", "preview", "live", "planning", "policy", "pressing", "ros"),
        )
    },
    "compressed": "compressed",
    "editing": "editing",
    "motion": "motion",
    "from_labels": "from-labels",
    "shards": "test-shards",
    **{f"{name}-run": f"test-{name}" for name in ("long", "soak", "replicas", "overload")},
}


class NotRecordable(Exception):
    """The figures cannot be recorded; the message says why."""


def recordable_commit() -> str:
    """The commit that figures are recorded for. Raises NotRecordable where there is none, or the sources differ."""
    here = commit()
    if here is None:
        raise NotRecordable("figures are recorded with their commit, and this is no checkout of git")
    if changed := changed_sources():
        names = ", ".join(changed[:_SHOWN]) + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")
        raise NotRecordable(f"figures are recorded of a commit; commit or stash these changes first: {names}")
    return here


def to_record(name: str, here: str) -> Document:
    """The new content of a file: figures of a commit, in place of its runs of the same names.

    Raises NotRecordable where the commit has not been measured.
    """
    document = read(staged(name))
    fresh = document if "measured" in document else {run: one for run, one in document.items() if _is_of(one, here)}
    if fresh.get("quick"):
        raise NotRecordable(f"{staged(name)} is of a quick run; measure it whole with make {TARGETS[name]}")
    if not fresh or ("measured" in fresh and not _is_of(fresh, here)):
        raise NotRecordable(f"{staged(name)} has no figures of commit {here}; measure them with make {TARGETS[name]}")
    return _beside_kept(name, fresh)


def _beside_kept(name: str, fresh: Document) -> Document:
    """Figures of a file; where it has runs, beside those that are kept of others."""
    return fresh if "measured" in fresh else {**read(kept(name)), **fresh}


def _is_of(document: Document, here: str) -> bool:
    return bool(document["measured"]["commit"] == here)


# Tables of `make bench`, `bench-console`, `test-shards`, `environment` and `ros`; others stand beside their programs.


def of_rows(**patterns: str) -> Callable[[Document], Lines]:
    """A table of the rows of a file; of each column the head, with _ for a blank, and the pattern of its cells."""
    return lambda measured: columns(measured["rows"], {head.replace("_", " "): one for head, one in patterns.items()})


def on_a_gpu(**patterns: str) -> Callable[[Document], Lines]:
    """`of_rows`, and the GPU that they were measured on."""

    def lines(measured: Document) -> Lines:
        yield from of_rows(**patterns)(measured)
        gpu, versions = measured["gpu"], measured["versions"]
        software = f"driver {gpu['driver']}, CUDA {gpu['cuda']}, torch {versions['torch']}, Triton {gpu['triton']}"
        yield from ("", f"{gpu['name']}, {software}.")

    return lines


def frames(measured: Document) -> Lines:
    """The kernel and the front doors, and the memory of a worker process."""
    row_lines = of_rows(
        What="{what}",
        Gaussians="{gaussians:,}",
        Threads="{threads}",
        Poses_at_once="{poses}",
        p50_ms="{p50_ms:.2f}",
        p99_ms="{p99_ms:.2f}",
        **{"Frames/s": "{frames_per_s:.0f}"},
        Above_kernel_ms="{above_kernel_ms:.2f}",
    )
    yield from row_lines(measured)
    memory = ", ".join(f"{int(count):,} Gaussians {mb:.0f} MB" for count, mb in measured["worker_memory_mb"].items())
    yield from ("", f"Memory of a worker process: with {memory}.")


def frames_at_a_glance(measured: Document) -> Lines:
    """What a reader of the README wants to know: the kernel and each front door, p50 and p99 by number of Gaussians."""
    names = {
        ("kernel", 1): "renderer, 1 thread",
        ("kernel", 2): "renderer, 2 threads",
        ("gRPC stream, shared memory", 2): "to a client of a gRPC stream, through shared memory",
        ("gRPC stream", 2): "the same through the connection, as from other hosts",
        ("HTTP raw", 2): "to a client over HTTP, raw pixels",
        ("HTTP PNG", 2): "to a client over HTTP, PNG",
    }
    of = {(row["what"], row["threads"], row["gaussians"]): row for row in measured["rows"] if row["poses"] == 1}
    counts = sorted({row["gaussians"] for row in measured["rows"]}, reverse=True)
    cells = "{p50_ms:.1f} / {p99_ms:.1f} ms"
    return table(
        ("Median / 99th percentile", *(f"{count:,} Gaussians" for count in counts)),
        ((name, *(cells.format_map(of[(*key, count)]) for count in counts)) for key, name in names.items()),
    )


def parts(measured: Document) -> Lines:
    """The parts of a frame in the kernel, and its work."""
    cells = {
        "Scene": "{what}",
        "Instructions": "{instruction_set}",
        "Frame ms": "{frame_ms:.2f}",
        **{name: f"{{{name.lower()}_ms:.2f}}" for name in ("Slicing", "Drawing", "Finishing")},
        **{name: f"{{{name.lower()}:,.0f}}" for name in ("Slices", "Groups", "Rows")},
        "Lanes used": "{lanes_used:.0%}",
        "ns a row": "{ns_per_row:.1f}",
        "MB moved": "{megabytes_moved:.0f}",
        f"Modelled on {', '.join(measured['rows'][0]['modelled_speedups'])} cores": "{modelled}",
    }
    rows = (
        {**row, "modelled": ", ".join(f"{speedup:.1f}" for speedup in row["modelled_speedups"].values())}
        for row in measured["rows"]
    )
    return columns(rows, cells)


def clients(measured: Document) -> Lines:
    """What each kind of client gets."""
    extent, by_client = measured["extent"], measured["clients"]
    patterns = {
        f"Control loop, gRPC stream at 60 Hz for {extent['loop_s']:.0f} s, mode `latest`": (
            "control loop",
            "p50 {p50_ms:.1f}, p99 {p99_ms:.1f}, p99.9 {p99.9_ms:.1f} ms; jitter {jitter_ms:.1f} ms; {dropped:.0f} of "
            "its poses dropped",
        ),
        **{
            name: (name, "{frames_per_s:.0f} frames/s, to each at least {least_frames_per_s:.0f}")
            for name in by_client
            if name.startswith("WebSocket")
        },
        "OpenIGTLink, one pose after another": ("OpenIGTLink", "p50 {p50_ms:.1f}, p99 {p99_ms:.1f} ms"),
        f"Augmentation: a job of {extent['frames']:,} frames, 8 bit, to npz, "
        f"{extent['gaussians']:,} random Gaussians": (
            "augmentation",
            "{frames_per_s:.0f} frames/s; the kernel by itself {kernel_frames_per_s:.0f}: {share_of_kernel:.0%}",
        ),
    }

    def filled(pattern: str, values: Document) -> str:  # a dot in a key is none of an attribute
        return pattern.replace("p99.9_ms", "p999_ms").format_map({k.replace(".", ""): v for k, v in values.items()})

    return table(("Client", "Measured"), ((what, filled(p, by_client[name])) for what, (name, p) in patterns.items()))


def seats(measured: Document) -> Lines:
    """How many clients a machine serves, by their rate: of what eight had together, a third left free."""
    frames_per_s = measured["clients"]["WebSocket, 8 client(s)"]["frames_per_s"]
    rates = (60, 30, 15, 5)
    rows = ((f"{rate} frames/s", f"{frames_per_s / rate * 2 / 3:.0f}", f"{frames_per_s / rate:.0f}") for rate in rates)
    side = measured["extent"]["side"]
    return table((f"Rate of each, {side}x{side}", "Seats", "Seats at most, with nothing left free"), rows)


def control_loop(measured: Document) -> Lines:
    """What a robot waits for."""
    names = {
        "median": "p50_ms",
        "99 of 100 frames": "p99_ms",
        "999 of 1,000 frames": "p99.9_ms",
        "time between two frames, standard deviation": "jitter_ms",
    }
    loop = measured["clients"]["control loop"]
    return table(
        ("From sending a pose to having its frame", "ms"), ((name, f"{loop[key]:.1f}") for name, key in names.items())
    )


def shards(measured: Document) -> Lines:
    """A batch on the queue and on Ray, beside the kernel."""
    extent, workers = measured["extent"], measured["extent"]["workers"]
    rows = [(f"kernel alone, {workers} processes of one thread", f"{measured['kernel_frames_per_s']:,.0f}", "", "")]
    for engine, name in (("queue", "queue"), ("ray", "Ray")):
        if (figures := measured.get(engine)) is not None:
            share = f"{figures['share_of_kernel']:.0%}"
            rows.append((f"{name}, {workers} workers", f"{figures['frames_per_s']:,.0f}", share, str(figures["kills"])))
    what = f"{extent['frames']:,} frames of {extent['side']}x{extent['side']}, {extent['shards']} shards"
    return table((what, "Frames/s", "Of the kernel", "Killed in the second half"), rows)


def jobs(measured: Document) -> Lines:
    """A service with a long list of jobs."""
    rows = ({"what": what, **of} for what, of in measured["latency_ms"].items())
    return columns(rows, {"What": "{what}", "p50 ms": "{p50:.1f}", "p99 ms": "{p99:.1f}"})


def frames_in_a_page(measured: Document) -> Lines:
    """Frames that Chromium renders itself."""
    memory, size = measured["memory_mib"], "{side}x{side} in the page, one core"
    shared, faster = "{side}x{side} by {workers} workers", "{together_ms:g} ms: {faster:g} times as fast"
    timed = "{browser_ms:g} ms, {frames_per_s:.0f} frames/s: {ratio:g} times the native 128 bits' {native_ms:g} ms"
    rows = [
        *((size.format_map(one), timed.format_map(one)) for one in measured["sizes"]),
        *((shared.format_map(one), faster.format_map(one)) for one in measured["sizes"] if "workers" in one),
        ("First frame after the page was opened", f"{measured['first_frame_ms'] / 1000:.2f} s"),
        (
            f"Memory of the page after {measured['frames_for_growth']:,} more frames",
            f"{memory['last']:.0f} MiB, {memory['first']:.0f} at first, at most {memory['most']:.0f}",
        ),
        ("Page and renderer", f"{measured['page_gzip_kb']:.0f} KB gzipped"),
    ]
    if "webgpu" in measured:
        drawn = "{side}x{side} by WebGPU on {adapter}".format_map(measured["webgpu"])
        rows.append((drawn, "{ms:g} ms, {frames_per_s:g} frames/s".format_map(measured["webgpu"])))
    return table(("What", "Measured"), rows)


def operations_of_a_frame(measured: Document) -> Lines:
    """What a frame costs by the plan that CUDA and WebGPU share, counted."""
    work = measured["work_per_frame"]["90000"]
    giga = work["operations"] / 1e9
    rows = [
        ("Gaussians that the image plane cuts", f"{work['slices']:,.0f} of {work['gaussians']:,}"),
        ("Evaluations of a Gaussian at a pixel", f"{work['pixel_evaluations'] / 1e6:.1f} million"),
        ("Floating-point operations", f"{giga:.2f} billion"),
        (
            "60 frames/s",
            f"{60 * giga:.0f} billion a second: {6 * giga:.0f}% of a GPU of 1 TFLOPS, {3 * giga:.0f}% of 2",
        ),
        ("2,000 frames/s", f"{2 * giga:.1f} TFLOPS"),
    ]
    return table(("A frame of 512x512", "Counted"), rows)


def console(measured: Document) -> Lines:
    """The console in Chromium."""
    texts = {
        "A sweep played at 512x512 for {seconds:.0f} s": (
            "{frames_per_s[median]:.0f} frames/s, {frames_per_s[least]:.0f} in its slowest ten seconds"
        ),
        "Heap after a collection": "{heap_mib[first]:.0f} MiB at first, at most {heap_mib[most]:.0f} MiB",
        "From a click in the 3D view until the picture shows it": (
            "{click_in_3d_ms[median]:.0f} ms, at most {click_in_3d_ms[most]:.0f} ms"
        ),
        "First paint": "{first_paint_s:.2f} s",
        "First image": "{first_image_s:.1f} s",
        "Size of the page": "{bundle_gzip_kb:.0f} KB gzipped",
    }
    paint_s, image_s = (measured[name] / 1000 for name in ("first_contentful_paint_ms", "first_image_ms"))
    known = {**measured, "first_paint_s": paint_s, "first_image_s": image_s}
    return table(("What", "Measured"), ([text.format_map(known) for text in row] for row in texts.items()))


def environment(measured: Document) -> Lines:
    """Steps a second of a random policy, by scene, size and number of environments; and the load meanwhile."""
    yield from of_rows(
        Scene="{scene}",
        Gaussians="{gaussians:,}",
        Frame="{side}x{side}",
        Environments="{environments}",
        Steps_a_second="{steps_per_s:,.0f}",
        Best_of_the_rounds="{best_steps_per_s:,.0f}",
        CPU_ms_a_step="{cpu_ms:.2f}",
    )(measured)
    yield from ("", f"The machine's load meanwhile, all programs together: {measured['load']:.1f}.")


@dataclass(frozen=True)
class Block:
    """One place in the documents: the file whose figures stand there, and the lines that are made of them."""

    source: str
    lines: Callable[[Document], Lines]
    part: Callable[[Document], Document] = dict  # of the runs

    def of(self, figures: Document) -> list[str]:
        """The lines; the last says where the figures come from."""
        part = self.part(figures)
        return [*self.lines(part), "", f"{described(part)}."]


BLOCKS = {
    "frames": Block("results", frames),
    "frames at a glance": Block("results", frames_at_a_glance),
    "training steps": Block(
        "training",
        of_rows(
            Gaussians="{gaussians:,}",
            Images="{images}",
            Threads="{threads}",
            Step_ms="{step_ms:.1f}",
            **{part.capitalize(): f"{{shares[{part}]:.0%}}" for part in ("forward", "loss", "backward", "optimizer")},
        ),
    ),
    "parts of a frame": Block("kernel", parts),
    "frames on a GPU": Block(
        "cuda",
        on_a_gpu(
            What="{what}",
            Gaussians="{gaussians:,}",
            Poses="{poses}",
            p50_ms="{p50_ms:.2f}",
            p99_ms="{p99_ms:.2f}",
            **{"Frames/s": "{frames_per_s:,.0f}"},
            Bandwidth="{bandwidth_share:.1%}",
            Arithmetic="{arithmetic_share:.1%}",
        ),
    ),
    "training steps on a GPU": Block(
        "cuda_training",
        on_a_gpu(
            Gaussians="{gaussians:,}",
            Images="{images}",
            Step_ms="{step_ms:.1f}",
            **{
                f"{part.capitalize()} ms": f"{{part_ms[{part}]:.1f}}"
                for part in ("forward", "loss", "backward", "optimizer")
            },
            **{"Peak MB": "{peak_memory_mb:,.0f}"},
        ),
    ),
    "clients": Block("clients", clients),
    "control loop": Block("clients", control_loop),
    "seats": Block("clients", seats),
    "jobs": Block("jobs", jobs),
    "shards": Block("shards", shards),
    "console": Block("console", console),
    "frames in a page": Block("browser", frames_in_a_page),
    "operations of a frame": Block("cuda", operations_of_a_frame),
    "live scenes": Block("live", live.live_scenes),
    "environment": Block("environment", environment),
    "foretold poses": Block("prediction", prediction.foretold_poses),
    "previewed frames": Block("preview", preview.previewed_frames),
    "displacement under a face": Block("pressing", pressing.displacements),
    "cost of pressing": Block("pressing", pressing.cost_of_pressing),
    "planned views": Block("planning", planning.planned_and_even),
    "policies": Block("policy", policy.reached_planes),
    "ros": Block("ros", of_rows(Frame="{side}x{side}", Way="{way}", p50_ms="{p50_ms:.1f}", p99_ms="{p99_ms:.1f}")),
    "results": Block("results_tables", results_tables.results),
    "results at a glance": Block("results_tables", results_tables.results_at_a_glance, results_tables.glanced_at),
    "methods": Block("methods_tables", methods_tables.methods),
    "ablations": Block("ablations", ablations.trained_without, ablations.of_sets),
    "ablations of the path": Block("ablations", ablations.path_without, ablations.of_hands),
    "poses": Block("poses", poses.refined_poses),
    "hand": Block("hand", hand.predicted, hand.of_paths),
    "scenes of a hand": Block("hand", hand.trained, hand.of_scenes),
    "compressed": Block("compressed", compressed.kept),
    "editing": Block("editing", editing.lines),
    "motion": Block("motion", motion.lines),
    "from_labels": Block("from_labels", from_labels.lines),
    "localization": Block("localization", localization.found_frames),
    "frames in motion": Block("localization", localization.frames_in_motion, localization.of_motion),
    "confidence": Block("confidence", confidence.confidence_and_uncertainty),
    "speckle": Block("speckle", speckle.textures),
    "decorrelation": Block("speckle", speckle.decorrelations),
    "cost of speckle": Block("speckle", speckle.costs),
}


def documents() -> list[Path]:
    """README.md and everything below docs/ that has a place for figures."""
    pages = [measuring.ROOT / "README.md", *sorted((measuring.ROOT / "docs").rglob("*.md"))]
    return [page for page in pages if _PLACE.search(page.read_text(encoding="utf-8"))]


def current(text: str, read_kept: Callable[[str], Document] = lambda name: read(kept(name))) -> str:
    """A document with the figures as the files have them."""

    def block(place: re.Match[str]) -> str:
        one = BLOCKS[place[1]]
        if not ((figures := read_kept(one.source)) and one.part(figures)):
            return f"{place[1]}{place[2]}Not measured yet: `make {TARGETS[one.source]} RECORD=1`.\n"
        lines = [*one.of(figures), ""]
        lines[-2] = f"`{kept(one.source).relative_to(measuring.ROOT)}`: {lines[-2]}"
        return f"{place[1]}{place[2]}" + "\n".join(lines)

    return _PLACE.sub(block, text)


def show(target: str) -> None:
    """Print the tables of what a target measured."""
    for name, one in BLOCKS.items():
        if TARGETS[one.source] != target or not (figures := read(staged(one.source))):
            continue
        if one.part(figures := _beside_kept(one.source, figures)):
            sys.stdout.write("\n".join((f"# {name}", "", *one.of(figures), "", "")))


def listing() -> Iterator[str]:
    """Each file with its origin, and how many commits of the product have come since."""
    for name in TARGETS:
        if not (figures := read(kept(name))):
            yield f"{name}: not measured yet (make {TARGETS[name]} RECORD=1)"
            continue
        yield f"{name}: {described(figures)}"
        for of in sorted({str(head["commit"]).removesuffix(DIRTY) for head in heads(figures)}):
            command = ["git", "-C", str(measuring.ROOT), "rev-list", "--count", f"{of}..HEAD", "--"]
            command += ["model", "workers", "service"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            since = f"{done.stdout.strip()} commits changed the product" if done.returncode == 0 else "age not known"
            yield f"    {of}: {since} since"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("do", choices=("ready", "record", "show", "list", "check"))
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(TARGETS))
    arguments = parser.parse_args()
    try:
        if arguments.do == "ready" or (arguments.do == "record" and arguments.names):
            here = recordable_commit()
            for name, document in {name: to_record(name, here) for name in arguments.names}.items():
                write_whole(kept(name), json.dumps(document, indent=1, allow_nan=False) + "\n")
                if name == "confidence":
                    confidence.draw(document)
    except NotRecordable as error:
        sys.exit(f"error: {error}")
    if arguments.do == "show":
        show(*arguments.names)
    if arguments.do == "list":
        sys.stdout.writelines(f"{line}\n" for line in listing())
    if arguments.do in ("record", "check"):
        for page in documents():
            text = page.read_text(encoding="utf-8")
            if (new := current(text)) != text:
                if arguments.do == "check":
                    name = page.relative_to(measuring.ROOT)
                    sys.exit(f"error: {name} is not what the figures say: run benchmarks/figures.py record")
                write_whole(page, new)


if __name__ == "__main__":
    main()
