"""Provenance of an artefact: commit, code, versions and machine."""

import os
import platform
import shutil
import subprocess
from importlib import metadata
from pathlib import Path

import jax

from rcirl_jax import __version__
from rcirl_jax.runtime.pipeline import code_sha256

# variables that decide how numbers are rounded
COMPILER = (
    *("XLA_FLAGS", "JAX_ENABLE_X64", "JAX_DISABLE_JIT"),
    *("JAX_DEFAULT_MATMUL_PRECISION", "JAX_NUMPY_DTYPE_PROMOTION"),
)
HOOK_VARIABLES = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
PACKAGES = (
    *("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "tensorstore"),
)


def provenance() -> dict:
    """Git commit, code, versions and machine of this process.

    Starts JAX's devices: after `join_processes` where there are several processes.
    """
    return {
        "git_commit": git_commit(),
        "code_sha256": code_sha256(),
        "environment": {k: v for k, v in os.environ.items() if k in COMPILER and v},
        "versions": {
            "python": platform.python_version(),
            "rcirl-jax": __version__,
            **{name: metadata.version(name) for name in PACKAGES},
        },
        "machine": platform.machine(),
        **processor(),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
    }


def processor() -> dict:
    """Model of the CPU and the cores that this process may use."""
    model, file = platform.processor(), Path("/proc/cpuinfo")
    if file.exists():
        lines = file.read_text().splitlines()
        names = [x.split(":", 1)[1].strip() for x in lines if "model name" in x]
        model = names[0] if names else model
    told = hasattr(os, "sched_getaffinity")  # not on macOS
    cores = len(os.sched_getaffinity(0)) if told else os.cpu_count()
    return {"cpu": model, "cores": cores}


def git_commit() -> str:
    """The checkout's commit, with "+" when it has changes; "" outside of one.

    An installed package reports nothing, even below another repository's folder.
    """
    root = Path(__file__).resolve().parents[2]
    if shutil.which("git") is None:
        return ""
    # neither a folder above nor a hook's variables may name another repository
    given = {k: v for k, v in os.environ.items() if k not in HOOK_VARIABLES}
    env = {**given, "GIT_CEILING_DIRECTORIES": str(root.parent)}

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *words],
            capture_output=True,
            text=True,
            check=False,
            env=env,
        )
        return done.stdout.strip() if done.returncode == 0 else ""

    # installed beside somebody else's files
    if not git("ls-files", "rcirl_jax/runtime/provenance.py"):
        return ""
    commit = git("rev-parse", "HEAD")
    dirty = git("status", "--porcelain", "--untracked-files=no")
    return commit + ("+" if commit and dirty else "")
