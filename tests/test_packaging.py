"""Packages as they are built and installed, their metadata, and the files that describe the project to others."""

from __future__ import annotations

import ast
import fnmatch
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
import yaml

from magpend_core.models import model_names
from pipeline.specification.files import shipped_workflows
from tests.programs import ROOT

pytestmark = pytest.mark.slow
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PROJECT = PYPROJECT["project"]
OLDEST = PROJECT["requires-python"].removeprefix(">=")
README = (ROOT / "README.md").read_text("utf-8")
RECIPE, CITATION, CI = (
    yaml.safe_load((ROOT / name).read_text("utf-8"))
    for name in ("recipe/recipe.yaml", "CITATION.cff", ".github/workflows/ci.yml")
)
PACKAGES = ("magpend_core/", "pipeline/", "workflows/")
PAGE = "pipeline/explorer/page/"
"""Sources of the explorer's page; the wheel has what is built from them."""


def tracked():
    """Files of the repository by name, those that are new and not ignored included."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs a git checkout")
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return {name for name in listed.split("\0") if name and (ROOT / name).is_file()}


def copy_files(names, folder):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


def build(source, out, *kinds):
    words = [sys.executable, "-m", "build", "--no-isolation", *kinds, "--outdir", str(out), str(source)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the sdist of the tracked files; the wheel is built from the sdist, as for a release."""
    folder = tmp_path_factory.mktemp("packages")
    # a file that is not tracked lies in a package, as after a build of the page
    copy_files(tracked(), folder / "source")
    junk = folder / "source" / PAGE / "node_modules" / "left.js"
    junk.parent.mkdir()
    junk.write_text("")
    build(folder / "source", folder / "dist")
    (wheel,), (sdist,) = folder.glob("dist/*.whl"), folder.glob("dist/*.tar.gz")
    return wheel, sdist


def names_in(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def installed_names():
    """Tracked files of the packages, by their places in an installation."""
    inside = {name for name in tracked() if name.startswith(PACKAGES) and not name.startswith(PAGE)}
    return {name.removeprefix("pipeline/face/") for name in inside}


def test_packages__have_the_tracked_files_and_no_others(built):
    """In the wheel those of the packages, in the sdist what wheels are built from."""
    assert names_in(built[0]) == installed_names()
    with tarfile.open(built[1]) as archive:
        names = {name.partition("/")[2] for name in (m.name for m in archive.getmembers() if m.isfile())}
    made = {name for name in names if name.startswith("magpend.egg-info/")} | {"PKG-INFO", "setup.cfg"}
    top = {"CHANGELOG.md", "CITATION.cff", "LICENSE", "MANIFEST.in", "README.md", "pyproject.toml", "setup.py"}
    assert names - made == {name for name in tracked() if name.startswith(PACKAGES)} | top


def test_wheel__metadata_pass_the_check_of_an_index(built):
    from twine.commands.check import check

    assert not check([str(path) for path in built], strict=True)
    with zipfile.ZipFile(built[0]) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        said = Parser().parsestr(archive.read(name).decode())
    assert said["Requires-Python"] == PROJECT["requires-python"]
    assert set(said.get_all("Provides-Extra")) == set(PROJECT["optional-dependencies"])
    assert said.get_all("License-File") == PROJECT["license-files"]


def test_wheel__is_installed_without_a_network_and_runs(built, tmp_path):
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile"]
    subprocess.run([*words, "--target", str(tmp_path / "site"), str(built[0])], check=True, capture_output=True)
    code = (
        "import magpend, magpend_core, pipeline, workflows, sys\n"
        "print(*(m.__path__[0] for m in (magpend, magpend_core, pipeline, workflows)), sep='\\n')\n"
        "from pipeline.specification.files import shipped_workflows; print(len(shipped_workflows()))\n"
        "import pipeline.cli.main, pipeline.report, pipeline.explorer\n"
        "from magpend_core.models import model_names; print(len(model_names()))\n"
    )
    around = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")])}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=tmp_path, env=around, capture_output=True, text=True, check=True)
    *places, n_workflows, n_models = done.stdout.splitlines()
    assert all(place.startswith(str(tmp_path / "site")) for place in places)
    assert (int(n_workflows), int(n_models)) == (len(shipped_workflows()), len(model_names()))


def test_versions__are_the_same_everywhere():
    """Of magpend in all its descriptions, and of the oldest Python that it runs on."""
    assert RECIPE["context"]["version"] == CITATION["version"] == PROJECT["version"]
    assert RECIPE["context"]["python_min"] == PYPROJECT["tool"]["mypy"]["python_version"] == OLDEST
    assert f"on Python {OLDEST} or later" in README
    tested = CI["jobs"]["versions"]["strategy"]["matrix"]
    said = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)]
    assert min(said, key=lambda v: int(v[2:])) == OLDEST
    assert set(said) <= set(tested["python"])
    (image,) = set(re.findall(r"^FROM python:([\d.]+)-slim", (ROOT / "Dockerfile").read_text(), re.M))
    assert image in said
    assert {"python": OLDEST, "resolution": "lowest-direct"} in tested["include"]
    assert CITATION["license"] == PROJECT["license"]
    assert [a["name"] for a in CITATION["authors"]] == [a["name"] for a in PROJECT["authors"]]
    assert f"https://doi.org/{CITATION['references'][0]['doi']}" in README


def test_dependencies__have_lower_bounds_alone():
    extras, groups = PROJECT["optional-dependencies"], PYPROJECT["dependency-groups"]
    every = [*PROJECT["dependencies"], *(d for listed in (*extras.values(), *groups.values()) for d in listed)]
    for text in every:
        if isinstance(text, str) and not text.startswith("magpend["):
            assert re.fullmatch(r"[A-Za-z][\w.-]*(\[[\w,]+\])?>=\d[\d.]*", text), text


def test_dependencies__are_all_packages_that_are_imported():
    """One that comes with another package today may not come tomorrow."""
    extras = [text for listed in PROJECT["optional-dependencies"].values() for text in listed]
    named = {re.split(r"[\[>]", text)[0].lower().replace("-", "_") for text in (*PROJECT["dependencies"], *extras)}
    named |= {"ipython"}  # asked for only where it runs already
    named |= {"libsbml"}  # of python-libsbml
    named |= {"pil", "pydantic_core", *(name.strip("/") for name in PACKAGES), "magpend"}  # pillow, a part of pydantic
    for name in installed_names():
        if not name.endswith(".py") or name == "workflows/magnet/make_discs.py":  # a script for developers
            continue
        path = ROOT / ("pipeline/face/" + name if name.startswith("magpend/") else name)
        for node in ast.walk(ast.parse(path.read_bytes())):
            absolute = isinstance(node, ast.ImportFrom) and node.level == 0
            whole = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module] if absolute else []
            for package in {module.partition(".")[0] for module in whole} - sys.stdlib_module_names:
                assert package.lower() in named, f"{name} imports {package}"


def test_extras_and_groups__are_named_and_installed():
    """Users are told of each extra; the whole suite needs all extras, and developers everything but bench."""
    extras, groups = set(PROJECT["optional-dependencies"]), PYPROJECT["dependency-groups"]
    pages = (p for top in ("pipeline", "docs") for s in ("py", "md") for p in (ROOT / top).rglob(f"*.{s}"))
    text = "".join(page.read_text("utf-8") for page in pages)
    assert [name for name in extras if not re.search(rf"(magpend|\.)\[{name}\]", text)] == []
    assert not extras & set(groups)
    (own,) = (text for text in groups["whole"] if text.startswith("magpend["))
    assert set(own[len("magpend[") : -1].split(",")) == extras
    assert {entry["include-group"] for entry in groups["dev"]} == set(groups) - {"dev", "bench"}
    for name, group in (("tests", "test"), ("slow tests", "dev")):
        (command,) = re.findall(rf"<!-- run: {name} -->\n```sh\n(.*?)\n```", README, re.DOTALL)
        assert f"--group {group} " in command


CONDA = {"dask[array]": "dask-core", "matplotlib": "matplotlib-base", "npTDMS": "nptdms"}
"""Packages that have another name in conda-forge."""


def in_conda(text):
    name, version = text.split(">=")
    return f"{CONDA.get(name, name)} >={version}"


def test_recipe__requires_what_the_package_requires():
    needs = RECIPE["requirements"]
    python, *others = needs["run"]
    assert python == "python >=${{ python_min }}"
    assert others == [in_conda(text) for text in PROJECT["dependencies"]]
    extras = PROJECT["optional-dependencies"].values()
    assert needs["run_constraints"] == [in_conda(text) for listed in extras for text in listed]
    (entry,) = RECIPE["build"]["python"]["entry_points"]
    assert entry == "magpend = " + PROJECT["scripts"]["magpend"]
    assert RECIPE["about"]["license"] == PROJECT["license"]
    assert RECIPE["about"]["license_file"] == PROJECT["license-files"]


def instructions():
    text = re.sub(r"\\\n", " ", (ROOT / "Dockerfile").read_text("utf-8"))
    return [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line and not line.startswith("#")]


def into_image(names):
    """Files that `COPY . .` takes: later lines of .dockerignore win, and `!` takes back."""
    rules = [r for r in (ROOT / ".dockerignore").read_text("utf-8").splitlines() if r and not r.startswith("#")]

    def is_left_out(name):
        out = False
        for rule in rules:
            pattern = rule.removeprefix("!").removeprefix("**/")
            parts = [name, *(str(parent) for parent in Path(name).parents)]
            places = [p for part in parts for p in ((part, Path(part).name) if "**/" in rule else (part,))]
            if any(fnmatch.fnmatchcase(place, pattern) and (pattern != "*" or "/" not in place) for place in places):
                out = not rule.startswith("!")
        return out

    return {name for name in names if not is_left_out(name)}


def test_dockerfile__is_the_main_job_for_a_user_without_rights():
    (main,) = re.findall(r"<!-- run: main job -->\n```sh\n(.*?)\n```", README, re.DOTALL)
    said = dict(instructions())  # the last of each kind
    words = yaml.safe_load(said["ENTRYPOINT"]) + yaml.safe_load(said["CMD"])
    assert main.endswith("bin/" + shlex.join(words))
    kinds = [kind for kind, _ in instructions()]
    assert kinds[-4:] == ["WORKDIR", "ENV", "ENTRYPOINT", "CMD"]
    assert kinds[-5] == "USER"
    assert said["USER"] != "root"


def test_dockerfile__copies_what_the_package_is_built_from_and_nothing_else(built, tmp_path):
    assert ("COPY", ". .") in instructions()
    files = into_image(tracked() | {"runs/quickstart/run.json", ".venv/pyvenv.cfg", "pipeline/__pycache__/x.pyc"})
    assert not [name for name in files if name.startswith((PAGE, "runs/", ".", "tests/", "docs/")) or "pyc" in name]
    build(copy_files(files, tmp_path / "source"), tmp_path / "dist", "--wheel")
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert names_in(wheel) == names_in(built[0])


def test_workflows__ask_for_no_rights_and_use_no_code_of_others():
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        flow = yaml.safe_load(path.read_text("utf-8"))
        assert flow["permissions"] == {}
        for job in flow["jobs"].values():
            for step in job["steps"]:
                assert step.get("uses", "actions/").startswith("actions/")
                # text of an event never becomes a part of a command
                assert "${{" not in step.get("run", "")
    assert CI["jobs"]["readme"]["steps"][-1]["run"] == "bash .ci/run"


def test_repository__passes_the_review_of_scientific_python():
    from repo_review.processor import process

    results = process(ROOT).results
    assert len(results) > 40
    failed = {one.name: one.err_msg for one in results if one.result is False}
    # an ignored check is one that fails, with its reason beside it
    ignored = {
        one.name for one in results if one.skip_reason and one.name in PYPROJECT["tool"]["repo-review"]["ignore"]
    }
    assert not failed
    assert ignored == set(PYPROJECT["tool"]["repo-review"]["ignore"])


# the Python that README's commands get


def test_setup__says_what_to_do_where_python_is_too_old():
    before = (3, int(OLDEST.partition(".")[2]) - 1)
    code = f"import runpy, sys; sys.version_info = {before}; runpy.run_path('setup.py')"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"magpend needs Python {OLDEST} or later, and this is {before[0]}.{before[1]}: ")
    for remedy in ("python3.12 -m venv .venv", "uvx --from . magpend run quickstart --plot"):
        assert remedy in line
        assert f"`{remedy}`" in README


def test_ci__runs_every_command_of_readme_with_the_python_that_is_there():
    text = (ROOT / ".ci" / "run").read_text("utf-8")
    assert re.findall(r'^run_command "(.*)"$', text, re.M) == re.findall(r"<!-- run: (.*) -->", README)
    assert "PATH=" not in text
