"""The C++ programs of `onboard/`, built for tests."""

import fcntl
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ONBOARD = Path(__file__).resolve().parents[2] / "onboard"


def run(*command, **options):
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, check=False, **options
    )
    assert done.returncode == 0, (done.stdout + done.stderr).decode()[-4000:]
    return done.stdout


def compiled(source, file, *flags):
    """A file compiled of one source without warnings, or a skip."""
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    strict = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
    run(compiler, "-std=c++17", "-O1", *strict, *flags, "-o", file, source)
    return str(file)


def configured(folder, *flags):
    """A build folder, or a skip with the reason."""
    compiler = os.environ.get("CXX", "c++")
    for tool in ("cmake", compiler):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} not found")
    probe = '#if !__has_include(<msgpack/unpack_template.h>)\n#error "none"\n#endif\n'
    flag = ("-x", "c++", "-fsyntax-only", "-")
    headers = subprocess.run(
        [compiler, *flag], input=probe.encode(), capture_output=True, check=False
    )
    if headers.returncode:
        pytest.skip("msgpack/unpack_template.h not found: install libmsgpack-dev")
    run("cmake", "-S", ONBOARD, "-B", folder, "-DRCIRL_WERROR=ON", *flags)
    return folder


def built(*targets):
    """The folder with these programs, under the sanitizers: one for all tests."""
    folder = ONBOARD.parent / "build" / "sanitized"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "CMakeCache.txt").exists():
            # without optimization, which takes the compiler three times as long
            configured(folder, "-DRCIRL_SANITIZE=ON", "-DCMAKE_CXX_FLAGS_RELEASE=-O0")
        run("cmake", "--build", folder, "--parallel", 2, "--target", *targets)
    return folder
