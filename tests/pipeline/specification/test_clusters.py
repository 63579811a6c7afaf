"""The ``[cluster]`` table, and the manifest for Kubernetes: their parts fit each other, and its commands start."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from pipeline.specification.clusters import load_cluster
from pipeline.specification.files import find_spec
from pipeline.specification.problems import SpecError
from tests.pipeline.factories import free_port, wait_for

WHOLE = """
[cluster]
kind = "slurm"
queue = "short"
account = "p-42"
cores = 16
memory = "32 GB"
walltime = "04:00:00"
min_jobs = 1
max_jobs = 8
prologue = ["module load python/3.12", "source $HOME/magpend/bin/activate"]
directives = ["--constraint=avx512"]
interface = "ib0"
scratch = "$TMPDIR"
"""


@pytest.fixture
def load(tmp_path):
    def read(text):
        path = tmp_path / "cluster.toml"
        path.write_text(text, "utf-8")
        return load_cluster(path)

    return read


def problems(load, text):
    with pytest.raises(SpecError) as refused:
        load(text)
    return refused.value.problems


@pytest.mark.parametrize("walltime", ["00:00:10", "00:01:00", "00:10:00", "01:00:00", "48:00:00"])
def test_cluster__workers_leave_before_their_job_ends(load, walltime):
    found = load(WHOLE.replace("04:00:00", walltime))
    assert (found.cores, found.memory_bytes, found.max_jobs) == (16, 32 * 10**9, 8)
    assert found.prologue[0] == "module load python/3.12"
    assert found.lifetime_s - found.stagger_s > 0
    margin = found.walltime_s - found.lifetime_s - found.stagger_s
    assert margin == min(max(found.walltime_s // 10, 30), 900, found.walltime_s // 2)
    found = load(WHOLE + 'lifetime = "03:00:00"\nlifetime_stagger = "00:10:00"\n')
    assert (found.lifetime_s, found.stagger_s) == (10800, 600)


def test_cluster__all_problems_at_once(load):
    wrong = [
        ("kind", '"slurmm"', "Did you mean 'slurm'?"),
        ("cores", "0", "must be at least 1"),
        ("memory", '"much"', "must be a number"),
        ("walltime", '"4h"', "must be hours"),
        ("max_jobs", "0", "must be"),
        ("partition", '"short"', "unknown key"),
        ("prologue", r'["two\nlines"]', "must be one line"),
        ("queue", '"a; rm -rf b"', "must be one word"),
    ]
    found = problems(load, "title = 'mine'\n[cluster]\n" + "\n".join(f"{key} = {value}" for key, value, _ in wrong))
    assert len(found) == 1 + len(wrong)
    for key, words in (("title", "unknown key"), *((f"cluster.{key}", words) for key, _, words in wrong)):
        assert any(f": {key}" in p and words in p for p in found), key


def test_cluster__what_does_not_fit_together(load):
    found = problems(load, WHOLE.replace("min_jobs = 1", 'min_jobs = 9\nlifetime = "04:00:00"'))
    assert len(found) == 2
    assert "min_jobs = 9: must be at most max_jobs = 8" in found[0]
    assert "must end before walltime = '04:00:00'" in found[1]
    text = WHOLE.replace("slurm", "sge")
    assert "such as '-pe smp 16'" in problems(load, text)[0]
    load(text.replace("--constraint=avx512", "-pe orte 16"))


def test_cluster__no_table(load, tmp_path):
    for text, words in (
        ("", "has no table [cluster]"),
        ("cluster = 3", "has no table [cluster]"),
        ("[cluster", "is not valid TOML"),
    ):
        assert words in problems(load, text)[0]
    with pytest.raises(SpecError, match="cannot be read"):
        load_cluster(tmp_path / "none.toml")


# ---- the manifest for dask's operator --------------------------------------------------------------------

DOCKERFILE = Path(__file__).parents[3] / "Dockerfile"


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
        wait_for(lambda: answer(url + path) == "ok")
        wait_for(lambda: "worker-0" in answer(url + "/json/identity.json"))
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(20)


def answer(url):
    """What a server says; nothing if it is not there yet."""
    try:
        with urllib.request.urlopen(url, timeout=5) as found:
            return found.read().decode()
    except OSError:
        return ""


def words(pod, dask, replaced):
    (container,) = pod["containers"]
    assert container["command"] == ["dask"]
    return [dask, *(replaced.get(word, word) for word in container["args"])]
