"""The tables of the documents, made from the files of measured figures; `BLOCKS` says which place has which."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import ablations
import confidence
import localization
import methods_tables
import poses
import results_tables
from bone_shadow import SHADOW_DB
from figures import Document, described
from ultragray.learn.report.tables import METRICS, shown_value
from ultragray_studies.comparison.tables import COST_HEADINGS
from ultragray_studies.scaling import DECIDED

Lines = Iterable[str]


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    names = list(head)
    yield f"| {' | '.join(names)} |"
    yield "|---" * len(names) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def _columns(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str]) -> Iterator[str]:
    """A row for each of `rows`; a column is its head and the pattern of its cells, empty where a figure is None."""

    def cell(pattern: str, row: Mapping[str, Any]) -> str:
        try:
            return pattern.format_map(row)
        except TypeError:
            return ""

    return _table(columns, ([cell(pattern, row) for pattern in columns.values()] for row in rows))


# Of `make bench`, `bench-console`, `test-shards`, `libraries`, `environment` and `ros`.


def frames(measured: Document) -> Lines:
    """The kernel and the front doors, and the memory of a worker process."""
    yield from _columns(
        measured["rows"],
        {
            "What": "{what}",
            "Gaussians": "{gaussians:,}",
            "Threads": "{threads}",
            "Poses at once": "{poses}",
            "p50 ms": "{p50_ms:.2f}",
            "p99 ms": "{p99_ms:.2f}",
            "Frames/s": "{frames_per_s:.0f}",
            "Above kernel ms": "{above_kernel_ms:.2f}",
        },
    )
    memory = ", ".join(f"{int(count):,} Gaussians {mb:.0f} MB" for count, mb in measured["worker_memory_mb"].items())
    yield from ("", f"Memory of a worker process: with {memory}.")


def frames_at_a_glance(measured: Document) -> Lines:
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
    return _table(
        ("Median / 99th percentile", *(f"{count:,} Gaussians" for count in counts)),
        (
            (name, *("{p50_ms:.1f} / {p99_ms:.1f} ms".format_map(of[(*key, count)]) for count in counts))
            for key, name in names.items()
        ),
    )


def steps(measured: Document) -> Lines:
    """Training steps and the shares of their parts."""
    columns = {"Gaussians": "{gaussians:,}", "Images": "{images}", "Threads": "{threads}", "Step ms": "{step_ms:.1f}"}
    parts = {name.capitalize(): f"{{shares[{name}]:.0%}}" for name in ("forward", "loss", "backward", "optimizer")}
    return _columns(measured["rows"], columns | parts)


def parts(measured: Document) -> Lines:
    """The parts of a frame in the kernel, and its work."""
    cores = list(measured["rows"][0]["modelled_speedups"])
    rows = (
        {**row, "modelled": ", ".join(f"{speedup:.1f}" for speedup in row["modelled_speedups"].values())}
        for row in measured["rows"]
    )
    return _columns(
        rows,
        {
            "Scene": "{what}",
            "Instructions": "{instruction_set}",
            "Frame ms": "{frame_ms:.2f}",
            **{name: f"{{{name.lower()}_ms:.2f}}" for name in ("Slicing", "Drawing", "Finishing")},
            **{name: f"{{{name.lower()}:,.0f}}" for name in ("Slices", "Groups", "Rows")},
            "Lanes used": "{lanes_used:.0%}",
            "ns a row": "{ns_per_row:.1f}",
            "MB moved": "{megabytes_moved:.0f}",
            f"Modelled on {', '.join(cores)} cores": "{modelled}",
        },
    )


def clients(measured: Document) -> Lines:
    """What each kind of client gets."""
    extent, by_client = measured["extent"], measured["clients"]
    loop, igtl, batch = (by_client[name] for name in ("control loop", "OpenIGTLink", "augmentation"))
    pages = {name: one for name, one in by_client.items() if name.startswith("WebSocket")}
    return _table(
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


def control_loop(measured: Document) -> Lines:
    """What a robot waits for."""
    names = {
        "median": "p50_ms",
        "99 of 100 frames": "p99_ms",
        "999 of 1,000 frames": "p99.9_ms",
        "time between two frames, standard deviation": "jitter_ms",
    }
    loop = measured["clients"]["control loop"]
    return _table(
        ("From sending a pose to having its frame", "ms"), ((name, f"{loop[key]:.1f}") for name, key in names.items())
    )


def shards(measured: Document) -> Lines:
    """A batch on the queue and on Ray, beside the kernel."""
    extent, workers = measured["extent"], measured["extent"]["workers"]
    rows = [(f"kernel alone, {workers} processes of one thread", f"{measured['kernel_frames_per_s']:,.0f}", "", "")]
    for engine, name in (("queue", "queue"), ("ray", "Ray")):
        if (found := measured.get(engine)) is not None:
            share = f"{found['share_of_kernel']:.0%}"
            rows.append((f"{name}, {workers} workers", f"{found['frames_per_s']:,.0f}", share, str(found["kills"])))
    what = f"{extent['frames']:,} frames of {extent['side']}x{extent['side']}, {extent['shards']} shards"
    return _table((what, "Frames/s", "Of the kernel", "Killed in the second half"), rows)


def jobs(measured: Document) -> Lines:
    """A service with a long list of jobs."""
    rows = ({"what": what, **of} for what, of in measured["latency_ms"].items())
    return _columns(rows, {"What": "{what}", "p50 ms": "{p50:.1f}", "p99 ms": "{p99:.1f}"})


def console(measured: Document) -> Lines:
    """The console in Chromium."""
    rate, heap, click = measured["frames_per_s"], measured["heap_mib"], measured["click_in_3d_ms"]
    return _table(
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


def environment(measured: Document) -> Lines:
    """Steps a second of a random policy, by size and contact."""
    rows = ({**row, "contact": row["contact"] or "assumed"} for row in measured["rows"])
    columns = {"Frame": "{side}x{side}", "Contact": "{contact}", "Steps/s": "{steps_per_s:.0f}"}
    return _columns(rows, {**columns, "p50 ms": "{p50_ms:.2f}", "p99 ms": "{p99_ms:.2f}"})


def ros(measured: Document) -> Lines:
    """From a pose to its image, through the ROS 2 node and without it."""
    columns = {"Frame": "{side}x{side}", "Way": "{way}", "p50 ms": "{p50_ms:.1f}", "p99 ms": "{p99_ms:.1f}"}
    return _columns(measured["rows"], columns)


def imports(measured: Document) -> Lines:
    """What scikit-image takes to install, and to import."""
    sizes = measured["installed_mb"]
    shown = ", ".join(f"{name} {size:.0f} MB" for name, size in sizes.items() if size >= 1.0)
    yield from (f"Installed: {sum(sizes.values()):.0f} MB ({shown}).", "")
    yield from _table(("Import", "ms"), ((f"`{name}`", f"{ms:.0f}") for name, ms in measured["import_ms"].items()))


def beside_scikit_image(measured: Document) -> Lines:
    """Time and difference of each piece of image processing."""
    return _table(
        ("What", "here", "ms", "scikit-image", "ms", "largest difference"),
        (
            (
                *(row["what"], row["ours_with"], f"{row['ours_ms']:.2f}"),
                *(f"`{row['theirs_with']}`", f"{row['theirs_ms']:.2f}", f"{row['difference']:.1g}"),
            )
            for row in measured["rows"]
        ),
    )


def shadows(measured: Document) -> Lines:
    """Ways to find the shadow of bone."""
    return _columns(
        measured["shadows"],
        {
            "Method": "{method}",
            "precision": "{precision:.0%}",
            "recall": "{recall:.0%}",
            "intersection over union": "{overlap:.0%}",
            "of speckle without a shadow": "{of_speckle:.0%}",
        },
    )


# Of `make results`: trainings beside classical methods.

ROW_NAMES = {
    "scene": "**scene**",
    "median": "median compounding",
    "mean": "mean compounding",
    "maximum": "maximum compounding",
    "linear": "linear between frames",
    "nearest": "nearest training frame",
}
README_ROWS = {
    "ultranerf_liver": "simulated liver, trained on two sweeps",
    "liver_convex": "human liver, convex probe",
    "spine_phantom": "spine phantom, 17 frames",
    "nwire_phantom": "N-wire phantom: bright dots in black",
    "phantom": "built-in phantom, an unseen tilt",
}
_HEADS = {"psnr_db": "PSNR, dB", "ms_ssim": "MS-SSIM", "gms": "GMS", "gmsd": "GMSD"}
_LESS_IS_BETTER = "gmsd"


def results(figures: Document) -> Lines:
    """A table of the trainings, one of each run's lead, then one of the metrics for each run."""
    known = {name: figures[name] for name in results_tables.RUNS if name in figures}
    yield from _columns(
        ({"name": name, **run} for name, run in known.items()),
        {
            "run": "{name}",
            "training / held-out frames": "{train_frames} / {val_frames}",
            "image": "{image}",
            "preset": "{preset}",
            "steps": "{steps:,}",
            "Gaussians": "{gaussians:,}",
            "ms a step": "{step_ms:.0f}",
            "total": "{total_s:.0f} s",
        },
    )
    yield from (
        "",
        "The scene less the better of median compounding and linear interpolation (GMSD: the better less the scene, so",
        "that more is better throughout):",
        "",
    )
    yield from _table(("run", *_HEADS.values()), ((name, *_leads(run)) for name, run in known.items()))
    yield ""
    for name, run in known.items():
        yield from (f"## {name}", "")
        yield from _table(("held-out frames", *_HEADS.values()), _metrics(run))
        yield from ("", " ".join(_notes(run)), "")
        if (shadow := run.get("shadow")) is not None:
            yield (
                f"Where bone takes more than {SHADOW_DB:g} dB: mean absolute error {shadow['scene_mae']:.4f} (scene) "
                f"against {shadow['median_mae']:.4f} (median compounding);"
            )
            yield from (f"mean transmittance of the scene {shadow['scene_transmittance']:.3f}.", "")


def _leads(run: Document) -> Iterator[str]:
    """The scene against the better of median compounding and linear interpolation, metric by metric."""
    means = {method: run["metrics"][method]["mean"] for method in ("scene", "median", "linear")}
    for key in _HEADS:
        sign = -1.0 if key == _LESS_IS_BETTER else 1.0
        lead = min(sign * (means["scene"][key] - means[method][key]) for method in ("median", "linear"))
        yield f"{lead:+.{_digits(key)}f}"


def _digits(key: str) -> int:
    return 2 if key == "psnr_db" else 3


def _metrics(run: Document) -> Iterator[list[str]]:
    means = {method: run["metrics"][method]["mean"] for method in ROW_NAMES}
    best = {key: (min if key == _LESS_IS_BETTER else max)(mean[key] for mean in means.values()) for key in _HEADS}
    for method, row_name in ROW_NAMES.items():
        cells = [row_name]
        for key in _HEADS:
            mean = f"{means[method][key]:.{_digits(key)}f}"
            shown = f"**{mean}**" if mean == f"{best[key]:.{_digits(key)}f}" else mean
            cells.append(f"{shown} ± {run['metrics'][method]['std'][key]:.{_digits(key)}f}")
        yield cells


def _notes(run: Document) -> Iterator[str]:
    yield f"Compounding with voxels of {run['voxel_mm']:g} mm."
    if run["split"]["train"]:
        yield f"Training frames {run['split']['train']}, held out {run['split']['val']} of the training file."
    if run["ms_ssim_scales"] < 5:
        yield f"MS-SSIM over {run['ms_ssim_scales']} scales, which is what the images hold."
    if run["settings"]:
        settings = ", ".join(f"{key} {value:,}" for key, value in run["settings"].items())
        yield f"Preset {run['preset']} with {settings}."


def glanced_at(figures: Document) -> Document:
    """The runs that the README shows."""
    return {name: figures[name] for name in README_ROWS if name in figures}


def results_at_a_glance(figures: Document) -> Lines:
    """The README's table, of the runs that it shows."""
    shown = "{psnr_db:.1f} dB, {ms_ssim:.3f}, {gmsd:.3f}"
    return _table(
        ("PSNR, MS-SSIM, GMSD", "training", "this scene", "median compounding", "linear interpolation"),
        (
            (
                *(README_ROWS[name], f"{run['total_s']:.0f} s"),
                *(shown.format_map(run["metrics"][one]["mean"]) for one in ("scene", "median", "linear")),
            )
            for name, run in figures.items()
        ),
    )


# Of `make methods`: all methods at equal time.


def methods(figures: Document) -> Lines:
    """A table of each run, best mean rank first, then what failed."""
    for name, run in ((name, figures[name]) for name in methods_tables.RUNS if name in figures):
        seconds = "" if run["budget_s"] is None else f", equal time {run['budget_s'] * run['times']:.0f} s"
        yield from (f"### {name}", "")
        yield f"{run['train_frames']} training and {run['val_frames']} held-out frames of {run['image']}{seconds}."
        yield ""
        measured = [run["methods"][key] for key in run["order"]]
        failed = [one for one in run["methods"].values() if one["failure"] is not None]
        yield from _table(
            ("method", *COST_HEADINGS, *(metric.heading for metric in METRICS), "mean rank"),
            (_method(one, [other["mean"] for other in measured]) for one in measured),
        )
        for one in failed:
            reason = one["failure"].replace("|", "/")
            yield f"| {one['title']} | failed: {reason} {'| ' * (len(COST_HEADINGS) + len(METRICS))}|"
        yield ""


def _method(one: Document, means: Sequence[Document]) -> Iterator[str]:
    yield from (one["title"], *one["cost"].values())
    for metric in METRICS:
        shown = shown_value(metric.name, one["mean"][metric.name])
        best = max((mean[metric.name] for mean in means), key=lambda value, sign=metric.sign: sign * value)
        bold = "**" if shown == shown_value(metric.name, best) else ""
        yield f"{bold}{shown}{bold}"
    yield f"{one['mean_rank']:.2f}"


# Of `make ablations`, `poses`, `localization` and `confidence`.


def trained_without(figures: Document) -> Lines:
    """Trainings without one part each, then the curve of texture."""
    steps, count = ablations.SHORTER["steps"], ablations.SHORTER["max_gaussians"]
    seeds = len(ablations.SEEDS)
    sets = list(dict.fromkeys(name.split(", ")[0] for name in figures))
    yield f"Trainings without one part each, of {steps} steps and {count:,} Gaussians: less than for the figures above."
    yield f"PSNR (dB) and MS-SSIM on held-out frames, mean and standard deviation over {seeds} seeds; then, where"
    yield from ("it is known, the mean absolute error in the shadow of bone.", "")

    def cell(of: str, variation: str, keys: Sequence[str]) -> str:
        runs = [figures.get(f"{of}, {variation}, seed {seed}", {}) for seed in ablations.SEEDS]
        shown = []
        for key in keys:
            if values := [run[key] for run in runs if key in run]:
                digits = {"psnr_db": 2, "shadow_mae": 4}.get(key, 3)
                shown.append(f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}")
        return " / ".join(shown) or "–"

    def variations(names: Iterable[str], keys: Sequence[str]) -> Iterator[str]:
        return _table(("", *sets), ((name, *(cell(of, name, keys) for of in sets)) for name in names))

    yield from variations(ablations.WITHOUT, ("psnr_db", "ms_ssim", "shadow_mae"))
    yield from (
        "",
        "The share of SSIM in the loss (`texture`): PSNR, MS-SSIM and GMSD on held-out frames, and the contrast of",
        "speckle (std/mean of the envelope), rendered and true:",
        "",
    )
    keys = ("psnr_db", "ms_ssim", "gmsd", "speckle_contrast", "true_speckle_contrast")
    yield from variations(ablations.CURVE, keys)


def refined_poses(figures: Document) -> Lines:
    """Trainings from poses with errors, with and without refinement."""
    rows = []
    for name, error in poses.CASES:
        runs = [run for key, run in figures.items() if key.startswith(f"{name}, {error}, ")]
        if not runs:
            continue
        mean = {
            key: float(np.mean([run[key] for run in runs])) for key in runs[0] if "_none" in key or "_frames" in key
        }
        scores = (f"{mean[f'psnr_db_{mode}']:.2f} dB / {mean[f'ms_ssim_{mode}']:.3f}" for mode in ("none", "frames"))
        added_mm, added_deg, left_mm, left_deg = (
            float(np.mean([run[which][unit] for run in runs])) for which in ("added", "left") for unit in ("mm", "deg")
        )
        removed = f"{1 - left_mm / added_mm:.0%}, {1 - left_deg / added_deg:.0%}" if error != poses.RECORDED else ""
        seeds = f" ({len(runs)} seeds)" if len(runs) > 1 else ""
        rows.append((name, f"{error}{seeds}", *scores, f"{left_mm:.2f} mm, {left_deg:.2f}°", removed))
    head = ("set", "errors", "PSNR and MS-SSIM without refinement", "with it", "error left over", "removed")
    return _table(head, rows)


def found_frames(figures: Document) -> Lines:
    """Held-out frames that were looked for."""
    return _columns(
        ({"name": name, **figures[name]} for name in localization.SETS if name in figures),
        {
            "set": "{name}",
            "held-out frames": "{frames}",
            f"within {localization.FOUND_MM:g} mm and {localization.FOUND_DEG:g}°": "{within:.0%}",
            "from the recorded pose": "{within_from_recorded:.0%}",
            "both end in one place": "{same_place:.0%}",
            "median error": "{median_mm:.2f} mm, {median_deg:.2f}°",
            "time, median and 90 of 100": "{p50_s:.2f} s, {p90_s:.2f} s",
        },
    )


def confidence_and_uncertainty(figures: Document) -> Lines:
    """What scenes tell of frames that they have not seen, beside what came out, cause by cause."""
    cells = list(confidence.cells(figures))
    rows = []
    for name, cause, found in cells:
        actual = np.array(found["actual"])
        agreements = []
        for key in ("told", "of_pose"):
            rank = f"{confidence.rank_correlation(found, key):.2f}" if confidence.is_telling(found) else "–"
            agreements.append(f"{confidence.error(found, key):.3f} / {rank}")
        spread = f"{actual.mean():.2f} ± {actual.std():.2f}"
        rows.append((name, str(figures[name]["training_frames"]), f"{cause} ({len(actual)})", spread, *agreements))
    yield from _table(("scene", "frames", "cause", "actual", "of the frame", "of the pose alone"), rows)
    yield ""
    telling = sum(confidence.is_telling(found) for *_, found in cells)
    for key, of_what in (("told", "Of rendered frames"), ("of_pose", "Of poses alone")):
        wrong = [f"{cause} of {name}" for name, cause, one in cells if confidence.error(one, key) > confidence.ERROR]
        mixed = [
            f"{cause} of {name}"
            for name, cause, one in cells
            if confidence.is_telling(one) and confidence.rank_correlation(one, key) < confidence.RANK
        ]
        listed, disordered = (", ".join(names) or "none" for names in (wrong, mixed))
        yield f"{of_what}, {len(wrong)} of {len(cells)} errors are above {confidence.ERROR:g}: {listed}."
        yield f"{len(mixed)} of {telling} rank correlations are below {confidence.RANK:g}: {disordered}."
        yield ""
    pixels = ({"scene": name, "cause": cause, **found["uncertainty"]} for name, cause, found in cells)
    numbers = {"expected": "{expected:.3f}", "actual": "{actual:.3f}"}
    shares = {"within 1σ": "{within_1:.0%}", "within 2σ": "{within_2:.0%}"}
    yield from _columns(pixels, {"scene": "{scene}", "cause": "{cause}", **numbers, **shares})


# Of `make simulation`: a mean over the runs ± half the width of its 95% confidence interval.

# Of each figure of an Outcome: the head of its column, the digits, and whether it is a share.
_FIGURES = {
    "hits": ("Hits", 1, True),
    "fetched_mb_per_s": ("Fetched MB/s", 0, False),
    "busy": ("Replicas busy", 0, True),
    "most_over_mean": ("Busiest / mean", 2, False),
    "variation": ("Variation", 2, False),
    "overfull": ("Overfull", 1, True),
    "wait_ms": ("Mean wait ms", 1, False),
    "wait_p95_ms": ("Wait p95 ms", 1, False),
    "pose_p50_ms": ("Pose p50 ms", 1, False),
    "pose_p99_ms": ("Pose p99 ms", 1, False),
    "pose_p999_ms": ("Pose p99.9 ms", 0, False),
    "unanswered": ("Unanswered", 2, True),
    "request_p50_ms": ("Request p50 ms", 0, False),
    "request_p99_ms": ("Request p99 ms", 0, False),
    "request_p999_ms": ("Request p99.9 ms", 0, False),
    "refused": ("Refused", 1, True),
    "replicas_of_hottest": ("Replicas of the hottest scene", 0, False),
}
_BALANCE = ("hits", "fetched_mb_per_s", "most_over_mean", "variation", "overfull")
_POSES = ("pose_p50_ms", "pose_p99_ms", "pose_p999_ms", "unanswered")
_REQUESTS = ("request_p50_ms", "request_p99_ms", "request_p999_ms", "refused")
# Of each table: the study, the head of its first column, and the figures that it shows.
SIMULATED = {
    "balance": ("policies", "Policy", (*_BALANCE, "replicas_of_hottest")),
    "latency": ("policies", "Policy", (*_POSES, *_REQUESTS)),
    "factors": (
        "factors",
        "Bound of the mean",
        (*_BALANCE, "pose_p99_ms", "unanswered", "request_p99_ms", "replicas_of_hottest"),
    ),
    "caches": (
        "caches",
        "Memory of each replica for scenes",
        ("hits", "fetched_mb_per_s", "busy", *_POSES[1:], *_REQUESTS[:3]),
    ),
    "load": (
        "load",
        "Streams for each replica",
        ("busy", "overfull", "wait_ms", "wait_p95_ms", *_POSES, "request_p99_ms"),
    ),
    "changes": ("changes", "Policy", ("hits", "fetched_mb_per_s", "overfull", *_POSES[1:], *_REQUESTS[1:])),
}


def simulated(table: str, document: Document) -> Lines:
    """A table of the simulation."""
    study, head, shown = SIMULATED[table]

    def cell(figure: str, mean: float, half: float) -> str:
        _, digits, is_share = _FIGURES[figure]
        if is_share:
            return f"{100.0 * mean:.{digits}f} ± {100.0 * half:.{digits}f}%"
        return f"{mean:,.{digits}f} ± {half:,.{digits}f}"

    return _table(
        (head, *(_FIGURES[figure][0] for figure in shown)),
        (
            (row, *(cell(figure, *found[figure]) for figure in shown))
            for row, found in document["studies"][study].items()
        ),
    )


def simulated_costs(document: Document) -> Lines:
    """What went into the simulation."""
    rows = (
        {**one, **{name: 1000.0 * one[name] for name in ("frame_s", "overhead_s", "load_s")}}
        | {name: one[name] / 1e6 for name in ("resident_bytes", "file_bytes")}
        for one in document["costs"]
    )
    columns = {"Gaussians": "{gaussians:,}", "Frame ms": "{frame_s:.2f}", "Door ms": "{overhead_s:.2f}"}
    sizes = {"In memory MB": "{resident_bytes:.1f}", "File MB": "{file_bytes:.1f}"}
    return _columns(rows, {**columns, "Load ms": "{load_s:.0f}", **sizes})


def decided(_: Document) -> Lines:
    """The values that Envoy's configuration and the chart take."""
    return _table(
        ("Setting", "Value"),
        (
            ("Envoy: `hash_balance_factor`", str(DECIDED.hash_balance_factor)),
            ("Envoy: `minimum_ring_size`", str(DECIDED.minimum_ring_size)),
            ("Replica: `memory_budget_mb`", str(DECIDED.memory_budget_mb)),
            (
                "More replicas where 5% of `ultragray_queue_seconds` are above",
                f"{DECIDED.queue_p95_ms:g} ms",
            ),
            ("which is where replicas are busy for", f"{100.0 * DECIDED.utilisation:.0f}% of their time"),
        ),
    )


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
    "training steps": Block("training", steps),
    "parts of a frame": Block("kernel", parts),
    "clients": Block("clients", clients),
    "control loop": Block("clients", control_loop),
    "jobs": Block("jobs", jobs),
    "shards": Block("shards", shards),
    "console": Block("console", console),
    "environment": Block("environment", environment),
    "ros": Block("ros", ros),
    "imports": Block("libraries", imports),
    "beside scikit-image": Block("libraries", beside_scikit_image),
    "shadows": Block("libraries", shadows),
    "results": Block("results_tables", results),
    "results at a glance": Block("results_tables", results_at_a_glance, glanced_at),
    "methods": Block("methods_tables", methods),
    "ablations": Block("ablations", trained_without),
    "poses": Block("poses", refined_poses),
    "localization": Block("localization", found_frames),
    "confidence": Block("confidence", confidence_and_uncertainty),
    "simulated costs": Block("simulation", simulated_costs),
    "simulated defaults": Block("simulation", decided),
    **{f"simulated {name}": Block("simulation", partial(simulated, name)) for name in SIMULATED},
}
