"""The page of a trained scene: complete, self-contained, and safe with any name."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.report.page import THIS_SCENE, Prediction, ScenePage, render_page
from ultragray.learn.report.plots import write_training_curve
from ultragray.learn.training import train
from ultragray.learn.training.progress import Course
from ultragray.learn.training.trainer import JOURNAL_FILE

from ..training.test_agreement import hand_path, recording
from ..training.test_poses import shaken

VOID = {"meta", "img", "link", "br"}


class Checked(HTMLParser):
    """A page whose tags are closed in order, and that loads nothing from elsewhere; its ids and addresses."""

    def __init__(self, text):
        super().__init__()
        self.open_tags = []
        self.addresses, self.ids = [], set()
        self.feed(text)
        assert self.open_tags == []
        assert all(address.startswith(("data:image/png;base64,", "#")) for address in self.addresses)
        assert "<script" not in text
        assert "url(http" not in text

    def handle_starttag(self, tag, attrs):
        self.ids |= {value or "" for name, value in attrs if name == "id"}
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open_tags.pop()

    def handle_endtag(self, tag):
        assert self.open_tags.pop() == tag


@pytest.fixture
def page(tiny_dataset, tiny_config, tmp_path):
    """The page of a training, whose course is that of the journal of its run."""
    dataset = replace(tiny_dataset(), name="tiny <sweep>")
    seen = []
    scene = train(dataset, tiny_config(steps=6), folder=tmp_path, report=seen.append)
    course = Course.of_journal(tmp_path / JOURNAL_FILE)
    assert course.losses == [progress.loss for progress in seen]
    assert course.val_psnr_db == {one.val_step: one.val_psnr_db for one in seen if one.val_step is not None}
    assert course.seconds == pytest.approx(6 * course.step_s)
    assert course.seconds > 0.0
    predictions = {THIS_SCENE: Prediction.of_scene(scene, dataset)}
    return ScenePage(dataset, scene, predictions, "a machine", scene_name="ball & <noise>", spread=2, course=course)


def test_the_page_of_a_scene_alone_with_frames_from_end_to_end(page, tmp_path):
    text = render_page(page)
    Checked(text)
    assert "tiny &lt;sweep&gt;" in text
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Held-out frames", "Pictures", "Training"]
    assert "<dt>Scene</dt><dd>ball &amp; &lt;noise&gt;</dd>" in text
    assert re.findall(r'<th scope="row">(.*?)</th>', text) == [THIS_SCENE, "true frames", THIS_SCENE]
    mean = evaluate(page.scene, page.dataset.val).mean
    assert f"{mean.psnr_db:.2f} ±" in text
    first, last = page.dataset.val.frame_numbers[[0, -1]]
    assert re.findall(r"<figcaption>Frame (\d+)</figcaption>", text) == [str(first), str(last)]
    assert text.count("<img ") == 2 * 5  # truth, the scene and how far it is off, what it is made of
    read_from_a_file = render_page(replace(page, course=None))
    assert re.findall(r"<h2>(.*?)</h2>", read_from_a_file) == ["Held-out frames", "Pictures"]
    write_training_curve(page.course, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_scene_on_a_path_of_its_own_has_a_row_of_scores_there(tiny_config):
    truth = hand_path()
    dataset = recording(truth, shaken(truth, 0.3, 0.2))
    scene = train(dataset, tiny_config(refine_poses="path"))
    prediction = Prediction.of_scene(scene, dataset)
    assert prediction.on_path == FrameMetrics(**scene.info.metrics)
    assert prediction.on_path != prediction.evaluation.mean
    text = render_page(ScenePage(dataset, scene, {THIS_SCENE: prediction}, "a machine", spread=1))
    Checked(text)
    names = [THIS_SCENE, f"{THIS_SCENE}, on the path", "true frames", THIS_SCENE]
    assert re.findall(r'<th scope="row">(.*?)</th>', text) == names
    assert f"<td>{prediction.on_path.psnr_db:.2f}</td>" in text
    assert "no held-out image has a part in" in text
