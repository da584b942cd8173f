"""The folder of scene files."""

import weakref

import pytest

from ultragray import GaussianScene
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray_workers import SceneStore
from ultragray_workers import scene_shelf as headers
from ultragray_workers.errors import SceneNotFound
from ultragray_workers.scene_names import SceneReference, base_name, check_scene_name, check_scene_reference
from ultragray_workers.scene_shelf import SceneShelf
from ultragray_workers.scenes import resident_bytes


def test_names_are_the_files_whose_names_can_stand_in_a_url(scene_folder):
    store = SceneStore(scene_folder)
    assert store.names() == ["a", "b"]
    for other in ("-x.ugr", "with space.ugr", "a.txt", ".hidden.ugr", "x" * 129 + ".ugr"):
        (scene_folder / other).write_bytes(b"")
    (scene_folder / "folder.ugr").mkdir()
    (scene_folder / "v1.2_b-c.ugr").write_bytes(b"")  # comes without a restart
    assert store.names() == ["a", "b", "v1.2_b-c"]


def test_a_folder_that_does_not_exist_has_no_scenes(tmp_path):
    store = SceneStore(tmp_path / "missing")
    assert store.names() == []
    with pytest.raises(SceneNotFound, match="there are no scenes yet"):
        store.header("a")


def test_the_first_folder_wins_over_further_ones(scene_folder, tmp_path):
    further = tmp_path / "further"
    further.mkdir()
    for name in ("b", "c"):
        (further / f"{name}.ugr").write_bytes((scene_folder / "a.ugr").read_bytes())
    store = SceneStore(scene_folder, further, tmp_path / "missing")
    assert store.names() == ["a", "b", "c"]
    assert store.path("b") == scene_folder / "b.ugr"
    assert store.path("c") == further / "c.ugr"
    with pytest.raises(SceneNotFound, match="known scenes: a, b, c"):
        store.path("d")
    assert store.header("c").info == store.header("a").info
    (scene_folder / "b.ugr").unlink()
    assert store.path("b") == further / "b.ugr"


def test_compressed_scenes_are_served_too_unless_there_is_another_of_the_name(scene_folder, tmp_path):
    GaussianScene.load(scene_folder / "b.ugr").save(scene_folder / "b.ugz")
    GaussianScene.load(scene_folder / "b.ugr").save(scene_folder / "c.ugz")
    store = SceneStore(scene_folder)
    assert store.names() == ["a", "b", "c"]
    assert (store.path("b").name, store.path("c").name) == ("b.ugr", "c.ugz")
    assert (store.header("b").is_compressed, store.header("c").is_compressed) == (False, True)
    (scene_folder / "b.ugr").unlink()
    assert store.header("b").is_compressed
    (shelf,) = store.shelves
    shelf.replace(scene_folder / "a.ugr", "c")
    assert not (scene_folder / "c.ugz").exists()
    assert not store.header("c").is_compressed


@pytest.mark.parametrize("name", ["c", "", "../a", "/etc/passwd", "a.ugr", "a/../a", "a\0", "x" * 200])
def test_unknown_and_impossible_names_are_not_found(scene_folder, name):
    with pytest.raises(SceneNotFound, match="known scenes: a, b"):
        SceneStore(scene_folder).path(name)


def test_headers_are_read_again_only_when_the_file_changes(scene_folder):
    store = SceneStore(scene_folder)
    assert store.cached_versioned_header("a") is None
    first = store.header("a")
    assert first.info.gaussian_count == 50
    assert store.header("a") is first
    assert store.cached_versioned_header("a") == (store.version("a"), first)
    (scene_folder / "b.ugr").replace(scene_folder / "a.ugr")
    assert store.cached_versioned_header("a") is None
    assert store.header("a") is not first
    (scene_folder / "a.ugr").unlink()
    assert store.cached_versioned_header("a") is None
    with pytest.raises(SceneNotFound):
        store.header("a")


def test_an_invalid_file_is_named_with_the_reason(scene_folder):
    (scene_folder / "bad.ugr").write_bytes(b"not a scene")
    with pytest.raises(SceneFileInvalid, match=r"bad\.ugr"):
        SceneStore(scene_folder).header("bad")


def test_a_loaded_scene_costs_two_and_a_half_times_its_parameters(scene_folder):
    info = SceneStore(scene_folder).header("a").info  # 50 Gaussians of degree 1: 15 floats each
    assert resident_bytes(info) == 2.5 * 50 * 15 * 4


def test_only_the_headers_used_last_are_kept(scene_folder, monkeypatch):
    described = headers._described_bytes(SceneStore(scene_folder).header("a"))
    monkeypatch.setattr(headers, "_KEPT_BYTES", 2.5 * described)
    store = SceneStore(scene_folder)
    for name in ("c", "d"):
        (scene_folder / f"{name}.ugr").write_bytes((scene_folder / "a.ugr").read_bytes())
    store.header("a")
    store.header("b")
    assert store.cached_versioned_header("a") is not None  # used later than b
    store.header("c")
    assert [name for name in ("a", "b", "c") if store.cached_versioned_header(name)] == ["a", "c"]


def test_headers_of_deleted_scenes_are_forgotten(scene_folder):
    store = SceneStore(scene_folder)
    for number in range(20):
        path = scene_folder / f"s{number}.ugr"
        path.write_bytes((scene_folder / "a.ugr").read_bytes())
        kept = weakref.ref(store.header(path.stem))
        assert kept() is not None
        path.unlink()
        if number % 2:
            assert store.cached_versioned_header(path.stem) is None
        else:
            store.forget(path.stem)
        assert kept() is None


def test_what_is_described_is_all_but_the_gaussians(scene_folder):
    header = SceneStore(scene_folder).header("a")
    path = scene_folder / "a.ugr"
    length = int.from_bytes(path.read_bytes()[:8], "little")
    assert headers._described_bytes(header) == 30 * (8 + length) + header.training_poses.nbytes


def test_a_pin_hides_nothing_and_shows_nothing(scene_folder):
    store = SceneStore(scene_folder)
    content = store.sha256("a")
    store.hides = lambda name: name == "a"
    for text in ("a", f"a@{content}"):
        assert store.cached_versioned_header(text) is None
        with pytest.raises(SceneNotFound, match="known scenes: b"):
            store.header(text)


def test_a_file_that_is_replaced_between_the_looks_at_it_is_looked_at_again(scene_folder, monkeypatch):
    """Else a frame of the new file would be told for the pin of the old one."""
    store = SceneStore(scene_folder)
    content = store.sha256("a")
    fetch = SceneShelf.fetch

    def replace_first(shelf, name):
        if (scene_folder / "b.ugr").exists():
            (scene_folder / "b.ugr").replace(scene_folder / "a.ugr")
        return fetch(shelf, name)

    monkeypatch.setattr(SceneShelf, "fetch", replace_first)
    with pytest.raises(SceneNotFound, match="no longer has the content"):
        store.versioned_header(f"a@{content}")


HASH = "0123456789abcdef" * 4


@pytest.mark.parametrize(
    ("text", "reference"),
    [
        ("liver", SceneReference("liver")),
        (f"liver@{HASH}", SceneReference("liver", HASH)),
        (f"liver@{HASH[:12]}", SceneReference("liver", HASH[:12])),
        (f"liver@{HASH[:11]}", None),
        (f"liver@{HASH}0", None),
        (f"liver@{HASH.upper()}", None),
        ("liver@", None),
        (f"@{HASH}", None),
        (f"a b@{HASH}", None),
        (f"liver@{HASH}@{HASH}", None),
        ("../liver", None),
    ],
)
def test_a_reference_is_a_name_and_perhaps_a_pin(text, reference):
    assert SceneReference.of(text) == reference
    if reference is None:
        with pytest.raises(InvalidArgument, match="scene must be"):
            check_scene_reference(text)
    else:
        check_scene_reference(text)
        assert base_name(text) == reference.name


def test_a_pin_fits_what_begins_with_it():
    assert SceneReference("liver").fits(HASH)
    assert SceneReference("liver", HASH[:12]).fits(HASH)
    assert not SceneReference("liver", "f" * 12).fits(HASH)


def test_nothing_new_is_named_with_a_pin():
    with pytest.raises(InvalidArgument, match="letters, digits"):
        check_scene_name(f"liver@{HASH}")
