"""`ultragray localize` and `ultragray calibrate`.

Where in a scene a real frame was taken, and how a robot or tracker lies to a scene.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.errors import InvalidArgument
from ultragray.exchange.poses import load_poses
from ultragray.files import npy_bytes, write_whole
from ultragray.learn.localization.pixels import read_frame
from ultragray.learn.localization.settings import SearchKind
from ultragray.scene.info import read_header
from ultragray_service.cli.terminal import (
    Backend,
    Force,
    Json,
    SceneFile,
    argument,
    check_file,
    command_group,
    examples,
    option,
    output_option,
    single,
    tell,
    warn,
    working,
)

if TYPE_CHECKING:
    from ultragray import Localization
    from ultragray.geometry.probe import FloatArray
    from ultragray.geometry.registration import Registration


POSE_SUFFIXES = (".npy",)


@single(
    "ultragray localize liver.ugr frame.png --start pose.npy",
    "ultragray localize liver.ugr frame.npy --start pose.json --within-mm 10 -o found.npy",
    "ultragray localize liver.ugr frame.png --search anywhere",
)
def localize(
    scene: SceneFile,
    image: Annotated[
        Path, argument("The frame, .png or .npy: rows along depth, columns across scan lines, not scan-converted.")
    ],
    start: Annotated[
        Path | None,
        option("A pose that is about right: .npy or .json, 4x4 or 3x4, in mm; .mcap.", shown="needed, unless anywhere"),
    ] = None,
    within_mm: Annotated[float, option("How far the start may be off.")] = 3.0,
    within_deg: Annotated[float, option("By which angle.")] = 5.0,
    search: Annotated[
        SearchKind, option("How much is known of the place: track: it is that of the frame before.")
    ] = SearchKind.NEAR,
    output: Annotated[Path | None, output_option("The pose as .npy, [4, 4].", default="not written")] = None,
    force: Force = False,
    json: Json = False,
    backend: Backend = "auto",
) -> None:
    """The probe is the one that the scene was trained with. Exit status 1: the frame was not found."""
    if output is not None:
        check_file(output, POSE_SUFFIXES, force=force)
    read_header(scene)
    about = None if start is None else _one_pose(start, "start")
    pixels = read_frame(image)

    from ultragray import GaussianScene
    from ultragray import localize as sought

    with working("looking for the frame …"):
        loaded = GaussianScene.load(scene)
        match = sought(
            loaded, pixels, about, within_mm=within_mm, within_deg=within_deg, search=search, backend=backend
        )
    if output is not None and match.is_found:
        write_whole(output, npy_bytes(match.pose))
    document = asdict(match) | {"pose": match.pose.tolist()}
    tell(_in_words(match, output), document, as_json=json)
    if not match.is_found:
        raise typer.Exit(1)


def _in_words(match: Localization, output: Path | None) -> str:
    from ultragray.learn.localization.search import FOUND_SIMILARITY

    if not match.is_found:
        return (
            f"not found: the place that looks most like it has a similarity of {match.similarity:.2f}, where "
            f"{FOUND_SIMILARITY} is needed; a start that is closer, or a larger --within-mm, may help"
        )
    position = ", ".join(f"{one:.2g}" for one in match.position_std_mm)
    angle = ", ".join(f"{one:.2g}" for one in match.angle_std_deg)
    rows = "\n".join("  " + "  ".join(f"{value:10.4f}" for value in row) for row in match.pose)
    where = "" if output is None else f"\nwrote {output}"
    return (
        f"found with a similarity of {match.similarity:.2f}, {match.shift_mm:.2f} mm and {match.turn_deg:.2f}° from "
        f"the start; standard deviations along and about the probe's axes: {position} mm, {angle}°\n{rows}{where}"
    )


SUFFIXES = (".json",)
calibrate_app = command_group(
    "What leads a robot's poses into a scene: probe→scene = base→scene · flange→base · probe→flange. For a tracked "
    "probe the base is the tracker, and the flange the marker on the probe."
)

Output = Annotated[Path, output_option("The registration, .json.")]
FlangePoses = Annotated[Path, argument("Poses flange→base, mm: .npy or .json.", metavar="FLANGE")]
Mounting = Annotated[Path | None, option("Pose probe→flange, mm: .npy or .json.", shown="the frames are the same")]


@calibrate_app.command(epilog=examples("ultragray calibrate points in_base.npy in_scene.npy -o robot.json"))
def points(
    in_base: Annotated[Path, argument("Points in the base, [N, 3] mm: .npy, .csv.")],
    in_scene: Annotated[Path, argument("The same ones in the scene.")],
    output: Output,
    probe_to_flange: Mounting = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """From three or more points that are known in both frames, not on a line. Exit status 1: they contradict each
    other, and nothing is written."""
    check_file(output, SUFFIXES, force=force)
    mounting = _mounting(probe_to_flange)
    import numpy as np

    from ultragray.geometry.contradictions import point_contradiction
    from ultragray.geometry.registration import Registration, register_points, rows

    known = _read_points(in_base), _read_points(in_scene)
    fit = register_points(*known)
    registration = Registration(
        base_to_scene=rows(fit.transform),
        probe_to_flange=rows(np.eye(4) if mounting is None else mounting),
        residual_mm=fit.rms_mm,
        position_std_mm=fit.position_std_mm,
        angle_std_deg=fit.angle_std_deg,
    )
    doubt = point_contradiction(fit, *known)
    _write(output, registration, "points", fit.residuals_mm.tolist(), [], doubt=doubt, as_json=json)


@calibrate_app.command(
    epilog=examples(
        "ultragray calibrate poses flange.npy probe.npy --probe-to-flange mounting.npy -o robot.json",
        "ultragray calibrate poses flange.npy probe.npy --find-mounting -o robot.json",
    )
)
def poses(
    flange: FlangePoses,
    probe: Annotated[Path, argument("The poses probe→scene at the same times: .npy or .json.")],
    output: Output,
    probe_to_flange: Mounting = None,
    find_mounting: Annotated[
        bool, option("Find probe→flange as well, from turns about two axes or more.", "--find-mounting")
    ] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """From poses of the flange and where the probe was in the scene: registration, and hand–eye calibration.

    Exit status 1: they contradict each other, and nothing is written; the worst sample and the likely cause are named.
    """
    check_file(output, SUFFIXES, force=force)
    if find_mounting and probe_to_flange is not None:
        raise InvalidArgument(
            "--find-mounting finds what --probe-to-flange gives: name one of them", field="find_mounting"
        )
    in_base, in_scene, mounting = load_poses(flange), load_poses(probe), _mounting(probe_to_flange)
    from ultragray.geometry.contradictions import pose_contradiction
    from ultragray.geometry.registration import register_poses, register_poses_and_mounting

    if find_mounting:
        fit = register_poses_and_mounting(in_base, in_scene)
    else:
        fit = register_poses(in_base, in_scene, mounting)
    residuals = fit.residuals_mm.tolist(), fit.residuals_deg.tolist()
    doubt = pose_contradiction(fit, in_base, in_scene, is_mounting_given=not find_mounting)
    _write(output, _registration(fit), "poses", *residuals, doubt=doubt, as_json=json)


@calibrate_app.command(
    epilog=examples(
        "ultragray calibrate frames liver.ugr flange.npy a.png b.png c.png --start about.npy -o robot.json",
        "ultragray calibrate frames liver.ugr flange.npy frames.npy --start old.npy --within-mm 10 -o robot.json",
    )
)
def frames(
    scene: SceneFile,
    flange: FlangePoses,
    images: Annotated[
        list[Path], argument("The real frames at these poses: .png each, or one .npy [N, H, W]; not scan-converted.")
    ],
    start: Annotated[Path, option("A pose base→scene that is about right: .npy or .json.")],
    output: Output,
    probe_to_flange: Mounting = None,
    within_mm: Annotated[float, option("How far the start puts the frames off.")] = 3.0,
    within_deg: Annotated[float, option("By which angle.")] = 5.0,
    force: Force = False,
    json: Json = False,
    backend: Backend = "auto",
) -> None:
    """From real frames and the robot's poses at them, by what the images show. Frames that do not fit are left out."""
    check_file(output, SUFFIXES, force=force)
    in_base, mounting, about = load_poses(flange), _mounting(probe_to_flange), _one_pose(start, "start")
    pixels = _read_frames(images)

    from ultragray import GaussianScene
    from ultragray.learn.registration import register_frames

    with working("looking for the frames …"):
        registration = register_frames(
            GaussianScene.load(scene),
            pixels,
            in_base,
            about,
            probe_to_flange=mounting,
            within_mm=within_mm,
            within_deg=within_deg,
            backend=backend,
        )
    left_out = sorted({*range(len(pixels))} - {*registration.agreeing})
    residuals = registration.fit.residuals_mm.tolist(), registration.fit.residuals_deg.tolist()
    _write(output, _registration(registration.fit), "frames", *residuals, left_out=left_out, as_json=json)


def _registration(fit: Any) -> Registration:
    import numpy as np

    from ultragray.geometry.registration import Registration, rows

    return Registration(
        base_to_scene=rows(fit.base_to_scene),
        probe_to_flange=rows(fit.probe_to_flange),
        residual_mm=float(np.sqrt(np.square(fit.residuals_mm).mean())),
        residual_deg=float(np.sqrt(np.square(fit.residuals_deg).mean())),
        position_std_mm=fit.position_std_mm,
        angle_std_deg=fit.angle_std_deg,
    )


def _read_points(path: Path) -> Any:
    import numpy as np

    if path.suffix.lower() not in (".npy", ".csv"):
        raise InvalidArgument(f"points must end in .npy or .csv, got {path.name!r}", field="points")
    try:
        return np.load(path, allow_pickle=False) if path.suffix.lower() == ".npy" else np.loadtxt(path, delimiter=",")
    except (OSError, EOFError, ValueError) as error:
        raise InvalidArgument(f"{path} cannot be read as points: {error}", field="points") from None


def _read_frames(paths: list[Path]) -> list[Any]:
    from ultragray.learn.localization.pixels import read_frame

    frames = [read_frame(path) for path in paths]
    return list(frames[0]) if len(frames) == 1 and frames[0].ndim == 3 else frames


def _mounting(path: Path | None) -> FloatArray | None:
    return None if path is None else _one_pose(path, "probe_to_flange")


def _one_pose(path: Path, field: str) -> FloatArray:
    poses = load_poses(path)
    if len(poses) != 1:
        raise InvalidArgument(f"{path} must hold one pose, got {len(poses)}", field=field)
    pose: FloatArray = poses[0]
    return pose


def _write(
    path: Path,
    registration: Registration,
    what: str,
    residuals_mm: list[float],
    residuals_deg: list[float],
    left_out: list[int] | None = None,
    *,
    doubt: str | None = None,
    as_json: bool,
) -> None:
    from ultragray.contract import to_dict
    from ultragray.geometry.registration import save_registration

    if doubt is None:
        save_registration(path, registration)
    document = to_dict(registration) | {"residuals_mm": residuals_mm, "residuals_deg": residuals_deg}
    document["warnings"] = [] if doubt is None else [doubt]
    if left_out is not None:
        document["left_out"] = left_out
    sentences = [
        f"{'wrote' if doubt is None else 'did not write'} {path}, from {len(residuals_mm)} {what}",
        f"residuals: {_range(residuals_mm)} mm" + (f", {_range(residuals_deg)}°" if residuals_deg else ""),
    ]
    if registration.position_std_mm is not None and registration.angle_std_deg is not None:
        position, angle = (
            ", ".join(f"{one:.2g}" for one in ones)
            for ones in (registration.position_std_mm, registration.angle_std_deg)
        )
        sentences.append(f"standard deviations along and about the scene's axes: {position} mm, {angle}°")
    if left_out:
        sentences.append(f"left out, as they were not found or do not fit the others: {', '.join(map(str, left_out))}")
    tell("\n".join(sentences), document, as_json=as_json)
    if doubt is not None:
        warn(doubt)
        raise typer.Exit(1)


def _range(values: list[float]) -> str:
    return f"{min(values):.2g} to {max(values):.2g}"
