"""What is released: locked versions, the wheel's files, the commit it reports."""

import re
import shutil
import subprocess
import tomllib
from zipfile import ZipFile

import pytest
from hatchling.builders.wheel import WheelBuilder
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from rcirl_jax.runtime import provenance
from tests.conftest import REPO

OWN = "rcirl_jax/runtime/provenance.py"  # whose commit is asked for
LOCKS = sorted((REPO / "requirements").glob("*.lock"))
VERSIONS = ("3.11.7", "3.12.1", "3.13.0", "3.14.0")
PIN = re.compile(
    r"^([\w.-]+)==(\S+)(?: ; ([^\\\n]+?))?((?: \\\n    --hash=\S+)+)$", re.M
)
HASH = re.compile(r"sha256:[0-9a-f]{64} ?\\?\n?\s*")


def pins(name):
    """(requirement, its hashes) of every line of a lock file."""
    text = (REPO / "requirements" / f"{name}.lock").read_text()
    found = [
        (
            Requirement(f"{n}=={v}" + (f" ; {m}" if m else "")),
            hashes.split("--hash=")[1:],
        )
        for n, v, m, hashes in PIN.findall(text)
    ]
    assert len(found) == len(re.findall(r"^[\w.-]+==", text, re.M))
    return found


def asked(extra, environment):
    """Requirements of the project with one extra, extras of its own unfolded."""
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
    todo = [*project["dependencies"], f"rcirl-jax[{extra}]"]
    while todo:
        requirement = Requirement(todo.pop())
        if requirement.name == "rcirl-jax":
            for name in requirement.extras:
                todo += project["optional-dependencies"][name]
        elif not requirement.marker or requirement.marker.evaluate(environment):
            yield requirement


def test_locked_files_have_hashes_and_no_place():
    for file in LOCKS:
        text = file.read_text()
        assert "://" not in text
        assert "--only-binary :all:" in text
        for requirement, hashes in pins(file.stem):
            assert hashes, requirement
            assert all(HASH.fullmatch(h) for h in hashes), requirement


def locked_for(name, version):
    """Name -> version locked for one Python, and that Python's environment."""
    environment = default_environment() | {
        "python_version": ".".join(version.split(".")[:2]),
        "python_full_version": version,
    }
    locked = {}
    for pin, _ in pins(name):
        if not pin.marker or pin.marker.evaluate(environment):
            assert pin.name not in locked, pin
            locked[pin.name] = next(iter(pin.specifier)).version
    return locked, environment


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("name", "extra"), [("all", "all"), ("test", "test"), ("floor", "quick")]
)
def test_what_the_project_asks_for_is_locked_once(name, extra, version):
    """The floor is the lowest allowed on the oldest Python, as newer have no wheels."""
    locked, environment = locked_for(name, version)
    wanted = list(asked(extra, environment))
    assert len(wanted) > 15
    for requirement in wanted:
        found = locked[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(found), f"{requirement}: {found}"
        if (name, version) == ("floor", VERSIONS[0]):
            (bound,) = (s.version for s in requirement.specifier if s.operator == ">=")
            assert Version(found) == Version(bound), requirement
    assert {"hatchling", "editables"} <= locked.keys()


def test_users_get_the_versions_that_are_tested():
    tested = {(pin.name, str(pin.specifier)) for pin, _ in pins("test")}
    assert {(pin.name, str(pin.specifier)) for pin, _ in pins("all")} <= tested


def test_the_wheel_holds_what_the_package_reads(tmp_path):
    builder = WheelBuilder(str(REPO))
    (wheel,) = builder.build(directory=str(tmp_path), versions=["standard"])
    packed = {name.split(".dist-info/")[-1] for name in ZipFile(wheel).namelist()}
    rooms = {"rcirl_jax": "", "data_specs": "rcirl_jax/"}
    wanted = {
        f"{above}{path.relative_to(REPO)}"
        for room, above in rooms.items()
        for path in (REPO / room).rglob("*.*")
        if "__pycache__" not in path.parts
    }
    assert len(wanted) > 250
    assert wanted <= packed
    assert {"rcirl_jax/py.typed", "licenses/LICENSE", "licenses/NOTICE"} <= packed
    assert "entry_points.txt" in packed
    # a folder called experiments is the user's own
    assert not any(name.startswith("experiments/") for name in packed)


def git(folder, *words):
    done = subprocess.run(
        ["git", "-C", folder, "-c", "user.name=a", "-c", "user.email=a@b", *words],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path):
    """A repository with one commit of a file, ours if it is a checkout."""
    git(tmp_path, "init", "--quiet")
    (tmp_path / "rcirl_jax" / "runtime").mkdir(parents=True)
    (tmp_path / OWN).write_text("1")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message=first")
    return tmp_path


def commit_of(root, monkeypatch):
    """What the package says when it lies in `root`."""
    monkeypatch.setattr(provenance, "__file__", str(root / OWN))
    return provenance.git_commit()


def test_the_commit_is_the_checkouts_that_knows_the_package(repository, monkeypatch):
    """Not of one that a package lies beside, as by `pip install --target=.`."""
    head = git(repository, "rev-parse", "HEAD")
    own = repository / OWN
    assert commit_of(repository, monkeypatch) == head
    own.write_text("2")
    assert commit_of(repository, monkeypatch) == head + "+"
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "which", lambda name: None)
        assert commit_of(repository, patch) == ""
    git(repository, "mv", "rcirl_jax", "theirs")
    git(repository, "commit", "--quiet", "--message=second")
    own.parent.mkdir(parents=True)
    own.write_text("1")
    assert commit_of(repository, monkeypatch) == ""
    monkeypatch.setenv("GIT_DIR", str(repository / ".git"))
    assert commit_of(repository / "venv", monkeypatch) == ""
