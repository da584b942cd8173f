"""The Helm chart as Helm renders it: Kubernetes takes it, and its pods run the service as it wants to be run."""

import re
import shutil
import subprocess

import pytest
import yaml

from ultragray.contract import annotated_fields
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings, load_settings

from ..surroundings import ROOT

helm = pytest.importorskip("helm_python", reason="Helm as a library is not installed: pip install 'ultragray[dev]'")
kubernetes_validate = pytest.importorskip("kubernetes_validate")

CHART = ROOT / "docker" / "helm"
NAME, NAMESPACE = "sim", "ultrasound"
LEAST = {
    "database": {"secretName": "database"},
    "storage": {"dataFolder": "s3://bucket/scenes", "artifactFolder": "s3://bucket/artifacts"},
}
ALL = {
    **LEAST,
    "secretNames": ["storage"],
    "settings": {"log_level": "debug", "queue_limit_frames": 512},
    "environment": {"AWS_ENDPOINT_URL": "https://s3.example"},
    "image": {"pullSecrets": ["registry"]},
    "service": {"gpus": 1, "image": {"tag": "cuda"}, "autoscaling": {"enabled": True}, "nodeSelector": {"gpu": "yes"}},
    "workers": {"cpu": {"autoscaling": {"enabled": True}}, "gpu": {"replicas": 2}},
    "autoscalingPrometheus": "http://prometheus:9090",
    "serviceMonitor": {"enabled": True, "keySecretName": "metrics", "labels": {"release": "prometheus"}},
}
ON_A_VOLUME = {
    "database": LEAST["database"],
    "storage": {"dataFolder": "/data", "artifactFolder": "/data/artifacts", "existingClaim": "shared"},
}
CASES = {"least": LEAST, "all": ALL, "volume": ON_A_VOLUME}
KUBERNETES = ("1.29", "1.37")  # the oldest that Chart.yaml names, and the newest whose schemas there are
OF_OTHERS = ("keda.sh/v1alpha1", "monitoring.coreos.com/v1")  # kinds that operators bring


def rendered(values, name=NAME):
    with helm.Chart.load(CHART) as chart:
        files = chart.render(values, name=name, namespace=NAMESPACE)
    texts = (text for path, text in files.items() if path.endswith(".yaml"))
    return [manifest for text in texts for manifest in yaml.safe_load_all(text) if manifest]


@pytest.fixture(scope="module", params=CASES)
def manifests(request):
    return rendered(CASES[request.param])


def of_kind(manifests, *kinds):
    return {one["metadata"]["name"]: one for one in manifests if one["kind"] in kinds}


def pods(manifests):
    """The pod templates by the names of what makes them."""
    makers = of_kind(manifests, "Deployment", "StatefulSet")
    return {name: maker["spec"]["template"] for name, maker in makers.items()}


def containers(manifests):
    for name, pod in pods(manifests).items():
        for container in pod["spec"]["containers"]:
            yield name, container


def environment(container):
    return {variable["name"]: variable.get("value", "") for variable in container.get("env", ())}


@pytest.mark.parametrize("case", CASES)
def test_helm_finds_nothing_wrong(case):
    report = helm.lint(CHART, CASES[case], strict=True)
    assert report["errors"] == []
    assert [message for message in report["messages"] if message["severity"] > 1] == []


@pytest.mark.parametrize("kubernetes", KUBERNETES)
def test_kubernetes_takes_it(manifests, kubernetes):
    for manifest in manifests:
        if manifest["apiVersion"] not in OF_OTHERS:
            kubernetes_validate.validate(manifest, kubernetes, strict=True)


def test_every_container_is_without_privileges_on_a_read_only_root(manifests):
    for name, pod in pods(manifests).items():
        spec = pod["spec"]
        assert spec["securityContext"]["runAsNonRoot"], name
        assert spec["securityContext"]["runAsUser"] == 10001, name
        assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}, name
        assert spec["automountServiceAccountToken"] is False, name
    for name, container in containers(manifests):
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }, name
        assert container["resources"]["requests"], name
        assert container["resources"]["limits"]["memory"], name


def test_what_the_image_writes_is_mounted(manifests):
    image = (ROOT / "docker" / "Dockerfile").read_text()
    declared = re.search(r'^VOLUME \["/data", "([^"]+)"\]$', image, re.MULTILINE)
    assert declared is not None
    for name, container in containers(manifests):
        if container["name"] in ("service", "worker"):
            mounted = {mount["mountPath"] for mount in container["volumeMounts"]}
            on_a_volume = environment(container)["ULTRAGRAY_DATA_FOLDER"].startswith("/data")
            assert mounted == {"/tmp", declared[1], *(["/data"] if on_a_volume else [])}, name


def test_variables_are_settings_that_there_are_and_within_their_limits(manifests, monkeypatch):
    known = {ENVIRONMENT_PREFIX + item.name.upper() for item, _ in annotated_fields(Settings)}
    for name, container in containers(manifests):
        given = {key: value for key, value in environment(container).items() if key.startswith(ENVIRONMENT_PREFIX)}
        assert set(given) <= known, name
        with monkeypatch.context() as patch:
            for key, value in given.items():
                patch.setenv(key, value or "postgresql://name:password@host/database")  # comes from a Secret
            load_settings()


def test_probes_ask_what_the_service_answers(manifests):
    (service,) = (container for _, container in containers(manifests) if container["name"] == "service")
    asked = {service[f"{kind}Probe"]["httpGet"]["path"] for kind in ("startup", "liveness", "readiness")}
    assert asked == {"/v1/health/live", "/v1/health/ready"}


def test_a_replica_that_stops_has_the_time_that_its_drain_takes(manifests):
    spec = pods(manifests)[f"{NAME}-service"]["spec"]
    (service,) = spec["containers"]
    stops_s = sum(float(environment(service)[f"ULTRAGRAY_DRAIN_{part}_S"]) for part in ("DELAY", "TIMEOUT"))
    assert spec["terminationGracePeriodSeconds"] >= stops_s + 10
    worker = pods(manifests)[f"{NAME}-worker-cpu"]["spec"]
    assert worker["terminationGracePeriodSeconds"] >= 2 * Settings().job_drain_timeout_s


def test_selectors_choose_the_pods_that_they_mean(manifests):
    labels = {name: pod["metadata"]["labels"] for name, pod in pods(manifests).items()}

    def chosen(selector):
        return [name for name, those in labels.items() if selector.items() <= those.items()]

    for name, maker in of_kind(manifests, "Deployment", "StatefulSet").items():
        assert chosen(maker["spec"]["selector"]["matchLabels"]) == [name]
    services = of_kind(manifests, "Service")
    assert chosen(services[NAME]["spec"]["selector"]) == [f"{NAME}-envoy"]
    assert chosen(services[f"{NAME}-service"]["spec"]["selector"]) == [f"{NAME}-service"]
    for name, budget in of_kind(manifests, "PodDisruptionBudget").items():
        assert chosen(budget["spec"]["selector"]["matchLabels"]) == [name]
    for name, policy in of_kind(manifests, "NetworkPolicy").items():
        assert chosen(policy["spec"]["podSelector"]["matchLabels"]) == [name]
    for name, scaled in of_kind(manifests, "ScaledObject").items():
        assert scaled["spec"]["scaleTargetRef"]["name"] == name
        assert "replicas" not in of_kind(manifests, "Deployment", "StatefulSet")[name]["spec"]


def test_envoy_asks_the_services_of_its_release(manifests):
    configuration = yaml.safe_load(of_kind(manifests, "ConfigMap")[f"{NAME}-envoy"]["data"]["envoy.yaml"])
    asked = {
        (cluster["name"].partition("_")[0], *endpoint["endpoint"]["address"]["socket_address"].values())
        for cluster in configuration["static_resources"]["clusters"]
        for group in cluster["load_assignment"]["endpoints"]
        for endpoint in group["lb_endpoints"]
    }
    services = of_kind(manifests, "Service")
    replicas = services[f"{NAME}-service"]["spec"]
    assert replicas["clusterIP"] == "None", "Envoy must see the address of each replica"
    assert asked == {(port["name"], f"{NAME}-service", port["port"]) for port in replicas["ports"]}
    listening = {
        one["name"]: one["address"]["socket_address"]["port_value"]
        for one in configuration["static_resources"]["listeners"]
    }
    assert listening == {port["name"]: port["port"] for port in services[NAME]["spec"]["ports"]}


def test_workers_on_gpus_ask_for_them_and_take_the_image_for_them():
    for name, container in containers(rendered(ALL)):
        on_gpu = name in (f"{NAME}-service", f"{NAME}-worker-gpu")
        if name != f"{NAME}-envoy":
            assert (container["resources"]["limits"].get("nvidia.com/gpu") == 1) is on_gpu, name
            assert container["image"] == f"ultragray:{'cuda' if on_gpu else 'cpu'}", name


def test_autoscaling_asks_for_metrics_that_the_service_has(tmp_path):
    scaled = of_kind(rendered(ALL), "ScaledObject")
    queries = {name: one["spec"]["triggers"][0]["metadata"]["query"] for name, one in scaled.items()}
    assert set(queries) == {f"{NAME}-service", f"{NAME}-worker-cpu"}
    told = (ROOT / "service/ultragray_service/telemetry/metrics.py").read_text()
    for query in queries.values():
        metrics = set(re.findall(r"ultragray_[a-z_]+", query))
        assert all(f'"{metric.removesuffix("_bucket")}"' in told for metric in metrics)
    if shutil.which("promtool"):
        rules = {"groups": [{"name": "queries", "rules": [{"record": "a:b", "expr": one} for one in queries.values()]}]}
        (tmp_path / "rules.yaml").write_text(yaml.safe_dump(rules))
        done = subprocess.run(["promtool", "check", "rules", tmp_path / "rules.yaml"], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"storage": LEAST["storage"]}, "database.secretName is missing"),
        ({"database": LEAST["database"]}, "storage.dataFolder is missing"),
        ({**ALL, "autoscalingPrometheus": ""}, "autoscalingPrometheus is missing"),
        ({**LEAST, "sevice": {"replicas": 3}}, "sevice"),
        ({**LEAST, "service": {"replica": 3}}, "replica"),
        ({**LEAST, "service": {"replicas": "three"}}, "replicas"),
        ({**LEAST, "workers": {"gpu": {"device": "gpu"}}}, "device"),
    ],
)
def test_wrong_values_are_refused_with_a_word(values, said):
    with pytest.raises(helm.HelmError, match=re.escape(said)):
        rendered(values)


def test_two_releases_in_one_namespace_are_apart():
    def names(release):
        return {(one["kind"], one["metadata"]["name"]) for one in rendered(LEAST, release)}

    assert names("one").isdisjoint(names("other"))
