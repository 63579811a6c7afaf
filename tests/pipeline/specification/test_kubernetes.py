"""The manifest for dask's operator: its parts fit each other and the image, and its commands start."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from pipeline.specification.files import find_spec

DOCKERFILE = Path(__file__).parents[3] / "Dockerfile"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def parts():
    """The objects of the manifest, by kind."""
    yaml = pytest.importorskip("yaml")
    text = (find_spec("quickstart").parent / "clusters" / "kubernetes.yaml").read_text("utf-8")
    return {part["kind"]: part for part in yaml.safe_load_all(text)}


@pytest.fixture(scope="module")
def pods(parts):
    """Specifications of the pods of scheduler, workers and coordinator."""
    cluster = parts["DaskCluster"]["spec"]
    job = parts["Job"]["spec"]["template"]["spec"]
    return {"scheduler": cluster["scheduler"]["spec"], "worker": cluster["worker"]["spec"], "coordinator": job}


def test_manifest__parts_fit_each_other(parts, pods):
    containers = {name: pod["containers"][0] for name, pod in pods.items()}
    assert {name: container["name"] for name, container in containers.items()} == dict(zip(pods, pods, strict=True))
    assert len({container["image"] for container in containers.values()}) == 1
    name = parts["DaskCluster"]["metadata"]["name"]
    service = parts["DaskCluster"]["spec"]["scheduler"]["service"]
    assert service["selector"]["dask.org/cluster-name"] == name
    ports = {port["name"]: port["containerPort"] for port in containers["scheduler"]["ports"]}
    assert {port["targetPort"]: port["port"] for port in service["ports"]} == ports
    # the operator calls the service NAME-scheduler
    assert f"tcp://{name}-scheduler:{ports['tcp-comm']}" in containers["coordinator"]["args"]
    claim = parts["PersistentVolumeClaim"]
    assert claim["spec"]["accessModes"] == ["ReadWriteMany"]
    for role in ("worker", "coordinator"):
        (volume,) = pods[role]["volumes"]
        assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
        (mount,) = containers[role]["volumeMounts"]
        assert mount["name"] == volume["name"]
        assert containers["coordinator"]["args"][-1].startswith(mount["mountPath"] + "/")


def test_manifest__fits_the_image(pods):
    """The coordinator's words follow the image's entry point; its user can write to the volume."""
    text = DOCKERFILE.read_text("utf-8")
    assert json.loads(re.search(r"^ENTRYPOINT (.*)$", text, re.MULTILINE)[1]) == ["magpend"]
    uid = int(re.search(r"--uid (\d+)", text)[1])
    folder = re.findall(r"^WORKDIR (\S+)$", text, re.MULTILINE)[-1]
    for role in ("worker", "coordinator"):
        assert pods[role]["securityContext"]["fsGroup"] == uid
        assert pods[role]["containers"][0]["volumeMounts"][0]["mountPath"] == f"{folder}/runs"
    assert "command" not in pods["coordinator"]["containers"][0]
    assert pods["worker"]["containers"][0]["command"] == pods["scheduler"]["containers"][0]["command"] == ["dask"]


def test_manifest__commands_start(pods, tmp_path):
    """Scheduler and worker start with the words of the manifest, the probe is answered, and the worker is there."""
    found = shutil.which("dask", path=Path(sys.executable).parent) or shutil.which("dask")
    if found is None:
        pytest.skip("the command dask is not on the PATH")
    port, probe = free_port(), free_port()
    scheduler = words(pods["scheduler"], found, {"0.0.0.0": "127.0.0.1", "8786": str(port), ":8787": f":{probe}"})
    worker = words(pods["worker"], found, {"$(DASK_WORKER_NAME)": "worker-0"})
    started = []
    try:
        for command in (scheduler, [*worker, f"tcp://127.0.0.1:{port}"]):
            started.append(
                subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            )
        url = f"http://127.0.0.1:{probe}"
        path = pods["scheduler"]["containers"][0]["readinessProbe"]["httpGet"]["path"]
        assert asked(url + path) == "ok"
        deadline = time.monotonic() + 60
        while "worker-0" not in asked(url + "/json/identity.json"):
            assert time.monotonic() < deadline
            time.sleep(0.1)
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(20)


def free_port():
    with socket.socket() as chosen:
        chosen.bind(("127.0.0.1", 0))
        return int(chosen.getsockname()[1])


def words(pod, dask, replaced):
    (container,) = pod["containers"]
    assert container["command"] == ["dask"]
    return [dask, *(replaced.get(word, word) for word in container["args"])]


def asked(url):
    deadline = time.monotonic() + 60
    while True:
        try:
            with urllib.request.urlopen(url, timeout=5) as answer:
                return answer.read().decode()
        except OSError:
            assert time.monotonic() < deadline, url
            time.sleep(0.1)
