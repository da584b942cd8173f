"""The dashboard and the alerts in docker/monitoring ask for metrics that a service has, with labels that these have."""

import json
import re
import shutil
import subprocess

import httpx
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from ..conftest import ROOT

MONITORING = ROOT / "docker" / "monitoring"
METRIC = re.compile(r"\b(?:ultragray|process)_[a-z_]+")
BY = re.compile(r"\bby \(([a-z, ]+)\)")
OF_PROMETHEUS = {"instance", "job", "le"}


def expressions():
    """Every query of the dashboard and of the alerts, by its place."""
    dashboard = json.loads((MONITORING / "dashboard.json").read_text())
    queries = {
        f"panel {panel['title']}, {target['refId']}": target["expr"]
        for panel in dashboard["panels"]
        for target in panel.get("targets", ())
    }
    for group in yaml.safe_load((MONITORING / "alerts.yaml").read_text())["groups"]:
        queries |= {f"alert {rule['alert']}": rule["expr"] for rule in group["rules"]}
    return queries


@pytest.fixture(scope="module")
def labels_of(service, module_pose):
    """The labels of each sample that a service has told once it rendered, answered and refused."""
    render = f"{service.http}/v1/scenes/demo/render"
    assert httpx.post(render, json={"pose": module_pose}, timeout=300).status_code == 200
    text = httpx.get(f"{service.http}/metrics", timeout=300).text
    found = {"ultragray_certificate_expires_timestamp_seconds": set()}  # only with TLS
    for family in text_string_to_metric_families(text):
        found.setdefault(family.name, set())
        if family.type == "counter":
            found.setdefault(f"{family.name}_total", set())
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


@pytest.fixture(scope="module")
def module_pose():
    return {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}


@pytest.mark.parametrize("place", expressions())
def test_queries_ask_for_metrics_that_there_are(labels_of, place):
    query = expressions()[place]
    metrics = set(METRIC.findall(query))
    assert metrics <= set(labels_of), place
    known = OF_PROMETHEUS.union(*(labels_of[metric] for metric in metrics))
    grouped = {label.strip() for labels in BY.findall(query) for label in labels.split(",")}
    if all(labels_of[metric] for metric in metrics):  # a counter without a sample yet does not tell its labels
        assert grouped <= known, place


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool, of Debian's package prometheus, is not there")
@pytest.mark.parametrize(
    "check", [["check", "rules", "alerts.yaml"], ["check", "config", "--syntax-only", "prometheus.yaml"]]
)
def test_prometheus_takes_its_files(check):
    *command, name = check
    done = subprocess.run(["promtool", *command, str(MONITORING / name)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_files_of_grafana_name_one_another():
    def read(name):
        return yaml.safe_load((MONITORING / name).read_text())

    used = {
        panel["datasource"]["uid"]
        for panel in json.loads((MONITORING / "dashboard.json").read_text())["panels"]
        if "datasource" in panel
    }
    assert used == {source["uid"] for source in read("grafana-datasource.yaml")["datasources"]}
