"""No name puts a line of its own into a job file."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.compute.jobqueue import settings
from pipeline.runs.jobs import coordinator_script
from pipeline.runs.submit import prepare
from pipeline.specification.clusters import QUEUES, cluster_of
from pipeline.specification.problems import SpecError

MARKS = ["#SBATCH --uid=0", "#PBS -l walltime=99:00:00", "#$ -l h_rt=99:00:00", "#BSUB -W 99:00"]
JOB = {"cores": 1, "memory": "1 GB", "walltime": "01:00:00"}


@pytest.mark.parametrize("kind", QUEUES)
@pytest.mark.parametrize("place", range(4))
def test_coordinator_script__refuses_line_breaks(kind, place):
    cluster = cluster_of({"kind": kind, **JOB})
    for mark in MARKS:
        words = ["magpend-a", "/logs/coordinator", "/home/me", "/home/me/a.toml"]
        assert coordinator_script(cluster, *words[:3], ["run", words[3]])
        for control in "\n\r\x00\x1b\u2028":
            words[place] = f"a{control}{mark}"
            with pytest.raises(SpecError, match="line breaks"):
                coordinator_script(cluster, *words[:3], ["run", words[3]])


@pytest.mark.parametrize("kind", QUEUES)
def test_settings__workers_refuse_line_breaks(kind):
    cluster = cluster_of({"kind": kind, **JOB})
    assert settings(cluster, Path("/logs"))
    for mark in MARKS:
        with pytest.raises(SpecError, match="line breaks"):
            settings(cluster, Path(f"/logs/a\n{mark}"))


@pytest.mark.slow
def test_prepare__working_directory_and_specification(tmp_path, write_spec, sweep_text, monkeypatch):
    place = tmp_path / "a\n#PBS -l walltime=99:00:00"
    place.mkdir()
    (place / "spec.toml").write_text(sweep_text)
    monkeypatch.setenv("PATH", str(tmp_path))  # no batch system of this machine is asked
    with pytest.raises(SpecError, match="line breaks"):
        prepare(place / "spec.toml", tmp_path / "out", "pbs", ["walltime=01:00:00", "cores=1", "memory=1 GB"])
    spec = write_spec(sweep_text)
    monkeypatch.chdir(place)
    with pytest.raises(SpecError, match="line breaks"):
        prepare(spec, tmp_path / "out", "pbs", ["walltime=01:00:00", "cores=1", "memory=1 GB"])
    assert not (tmp_path / "out.jobs").exists()
