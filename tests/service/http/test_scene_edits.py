"""Scenes that are edited, or made from labels, through each door: new ones, which tell what they were made of."""

import base64
import json

import pytest
from typer.testing import CliRunner

from ultragray import GaussianScene
from ultragray.learn.motion import add_motion
from ultragray.scene.motion_settings import MotionSettings
from ultragray_client import (
    BoxShape,
    Client,
    InsertEdit,
    LabelShape,
    LinearProbe,
    MergeEdit,
    SceneRecipe,
    TissueBody,
    TubeShape,
    errors,
)
from ultragray_service.cli.app import app

KEY = "0123456789abcdef-edits"
CYST = {"kind": "insert", "tissue": "cyst", "shape": {"kind": "sphere", "centre_mm": [0, 0, 12], "radius_mm": 3}}
CUT = {"kind": "cut", "shape": {"kind": "box", "min_mm": [-30, -30, -5], "max_mm": [0, 30, 40]}}


BLOCK = {"kind": "box", "min_mm": [-12, -8, 0], "max_mm": [12, 8, 24]}
RECIPE = {
    **{"bodies": [{"tissue": "liver", "shape": BLOCK}], "towards": [0, 0, 1], "along": [0, 1, 0]},
    **{"probe": {"kind": "linear", "width_mm": 20, "near_mm": 0, "far_mm": 20}, "sweep_mm": 8, "gaussian_count": 1500},
}


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts, api_keys=KEY)


def test_an_edit_makes_a_scene_that_names_its_parent_and_what_was_put_in(http):
    before = http.get("/v1/scenes/demo").json()
    answer = http.post("/v1/scenes/demo:edit", json={"into": "with-cyst", "edits": [CUT, CYST]})
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert (list(made["parents"]), made["made_labels"]) == (["demo"], ["cyst"])
    assert [json.loads(edit)["kind"] for edit in made["edits"]] == ["cut", "insert"]
    assert "labels" in made["outputs"]
    after = http.get("/v1/scenes/demo").json()
    assert {**after, "loaded": None, "loaded_processes": None} == {**before, "loaded": None, "loaded_processes": None}
    again = http.post("/v1/scenes/demo:edit", json={"into": "with-cyst", "edits": [CYST]})
    assert again.json()["reason"] == "SCENE_EXISTS"


def test_the_strokes_of_a_brush_are_one_edit(http):
    spheres = [{"kind": "sphere", "centre_mm": [0.002 * i - 10, 0, 12], "radius_mm": 2} for i in range(10_000)]
    edit = {"kind": "relabel", "label": "painted", "shapes": spheres}
    answer = http.post("/v1/scenes/demo:edit", json={"into": "painted", "edits": [edit]})
    assert answer.status_code == 201, answer.text
    assert list(answer.json()["label_names"].values()) == ["painted"]


def test_grpc_takes_every_kind_of_shape_and_merges_scenes_of_the_service(service, http):
    assert http.post("/v1/scenes/demo:edit", json={"into": "left", "edits": [CUT]}).status_code == 201
    right = {"into": "right", "edits": [{**CUT, "keep": "outside"}]}
    assert http.post("/v1/scenes/demo:edit", json=right).status_code == 201
    tube = TubeShape(points_mm=((0.0, -9.0, 12.0), (0.0, 9.0, 12.0)), radius_mm=2.0)
    with Client(service.grpc, api_key=KEY) as client:
        edits = [MergeEdit(scene="right", match_gain=False), InsertEdit(shape=tube, tissue="blood", label="vessel")]
        whole = client.scenes.edit("left", edits, into="whole")
        assert set(whole.parents) == {"left", "right"}
        assert whole.made_labels == ("vessel",)
        assert whole.gaussian_count > client.scenes.get("demo").gaussian_count
        with pytest.raises(errors.SceneNotFound):
            client.scenes.edit("left", [MergeEdit(scene="nowhere")], into="none")
        with pytest.raises(errors.InvalidArgument) as told:
            client.scenes.edit("left", [InsertEdit(shape=LabelShape(name="x"))], into="none")
    assert told.value.field == "edits[0].insert.shape" or "shape" in told.value.field


@pytest.mark.parametrize(
    ("edits", "field"),
    [
        ([], "edits"),
        ([{"kind": "melt"}], "edits[0]"),
        ([{**CYST, "shape": {"kind": "sphere", "centre_mm": [0, 0, 12], "radius_mm": 0}}], "edits[0].shape.radius_mm"),
        ([{**CUT, "shape": {"kind": "mesh", "data": base64.b64encode(b"no mesh").decode()}}], "edits[0].data"),
        ([{**CUT, "shape": {"kind": "sphere", "centre_mm": [900, 0, 0], "radius_mm": 1}}], "edits"),
    ],
)
def test_what_cannot_be_done_is_refused_and_leaves_nothing(http, edits, field):
    answer = http.post("/v1/scenes/demo:edit", json={"into": "none", "edits": edits})
    assert answer.status_code == 422, answer.text
    assert answer.json()["field"].startswith(field), answer.text
    assert http.get("/v1/scenes/none").status_code == 404


def test_the_command_line_edits_files_and_scenes_of_a_service(service, demo_scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    demo_scene.save("demo.ugr")
    (tmp_path / "edits.toml").write_text(
        '[[edits]]\nkind = "relabel"\nlabel = "spot"\n'
        'shapes = [{kind = "sphere", centre_mm = [0, 0, 12], radius_mm = 4}]\n'
    )
    runner = CliRunner()
    short = ["--insert", "tumour", "--at-mm", "0,0,12", "--radius-mm", "3"]
    found = runner.invoke(app, ["edit", "demo.ugr", "-o", "new.ugr", "--edits", "edits.toml", *short, "--json"])
    assert found.exit_code == 0, found.output
    made = GaussianScene.load("new.ugr")
    assert set(made.info.label_names.values()) >= {"spot", "tumour"}
    assert list(made.info.provenance["parents"]) == ["demo"]
    shown = runner.invoke(app, ["show", "new.ugr", "--json"])
    assert [edit["kind"] for edit in json.loads(shown.output)["provenance"]["edits"]] == ["relabel", "insert"]
    address = ["--address", service.http, "--api-key", KEY]
    there = runner.invoke(app, ["scenes", "edit", "demo", "--into", "by-command", *short, *address, "--json"])
    assert there.exit_code == 0, there.output
    assert json.loads(there.output)["made_labels"] == ["tumour"]


def test_both_commands_and_the_answer_tell_what_an_edit_left_out(service, http, demo_scene, tmp_path):
    breathing, still = tmp_path / "breathing.ugr", tmp_path / "demo.ugr"
    demo_scene.save(still)
    runner, scene = CliRunner(), add_motion(demo_scene, MotionSettings(chest_mm=4.0)).scene
    scene.save(breathing)
    raw = {"Content-Type": "application/octet-stream"}
    assert http.put("/v1/scenes/breathing", content=breathing.read_bytes(), headers=raw).status_code == 201
    cut = http.post("/v1/scenes/breathing:edit", json={"into": "breathing-cut", "edits": [CUT]}).json()
    assert cut["motion"]["modes"][0]["name"] == "breathing"
    here = runner.invoke(app, ["edit", str(breathing), "-o", str(tmp_path / "both.ugr"), "--merge", str(still)])
    address = ["--address", service.http, "--api-key", KEY]
    there = runner.invoke(app, ["scenes", "edit", "breathing", "--into", "both", "--merge", "demo", *address])
    for result in (here, there):
        assert result.output.endswith("; left out: modes of motion\n"), result.output
    both = http.get("/v1/scenes/both").json()
    assert (both["motion"], json.loads(both["edits"][0])["left_out"]) == (None, ["modes of motion"])


def test_the_help_of_scenes_from_labels_names_the_tables_of_bodies():
    assert "[[bodies]]" in " ".join(CliRunner().invoke(app, ["from-labels", "--help"]).output.split())


def test_every_door_makes_scenes_from_labels(service, http, tmp_path, monkeypatch):
    answer = http.post("/v1/scenes:from-labels", json={**RECIPE, "into": "made"})
    assert answer.status_code == 201, answer.text
    assert (answer.json()["made_labels"], answer.json()["parents"]) == (["liver"], {})
    frame = http.post(
        "/v1/scenes/made/render", json={"pose": {"matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}
    )
    assert frame.status_code == 200, frame.text
    assert json.loads(frame.headers["x-ultragray-extrapolation"])["supported_share"] == 0.0
    block = BoxShape(min_mm=(-12.0, -8.0, 0.0), max_mm=(12.0, 8.0, 24.0))
    probe = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)
    recipe = SceneRecipe(
        bodies=(TissueBody(tissue="liver", shape=block),),
        **{"towards": (0.0, 0.0, 1.0), "along": (0.0, 1.0, 0.0), "probe": probe, "sweep_mm": 8.0},
        gaussian_count=1500,
    )
    with Client(service.grpc, api_key=KEY) as client:
        assert client.scenes.from_labels(recipe, into="made-by-grpc").gaussian_count == answer.json()["gaussian_count"]
        with pytest.raises(errors.SceneExists):
            client.scenes.from_labels(recipe, into="made")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "block.json").write_text(json.dumps({name: RECIPE[name] for name in RECIPE if name != "sweep_mm"}))
    asked = ["--tissue", "block.json", "--sweep-mm", "8", "--json"]
    runner = CliRunner()
    here = runner.invoke(app, ["from-labels", "-o", "block.ugr", *asked])
    assert here.exit_code == 0, here.output
    assert GaussianScene.load("block.ugr").gaussian_count == answer.json()["gaussian_count"]
    address = ["--address", service.http, "--api-key", KEY]
    there = runner.invoke(app, ["scenes", "from-labels", "--into", "made-by-command", *asked, *address])
    assert there.exit_code == 0, there.output
    refused = http.post(
        "/v1/scenes:from-labels", json={**RECIPE, "into": "none", "bodies": [{"tissue": "liver", "label": 1}]}
    )
    assert (refused.status_code, refused.json()["field"]) == (422, "label_map")
