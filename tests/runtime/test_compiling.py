"""Seconds of compilations, of all programs or one; a bar that says why it waits."""

import os

import jax
import jax.numpy as jnp

from rcirl_jax.runtime.compiling import compiles, use_cache


def test_compilations_are_heard_inside_the_block_only():
    def doubled(x):
        return 2.0 * x

    def halved(x):
        return 0.5 * x

    jax.config.update("jax_enable_compilation_cache", False)
    try:
        with compiles() as every, compiles("jit(halved)") as one:
            jax.jit(doubled)(jnp.ones(3)).block_until_ready()
            jax.jit(halved)(jnp.ones(3)).block_until_ready()
        heard = len(every)
        jax.jit(lambda x: x + 3.0)(jnp.ones(5)).block_until_ready()
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    assert len(one) == 1
    assert heard >= 2
    assert len(every) == heard
    assert all(seconds > 0.0 for seconds in every)


def test_the_cache_is_bounded_the_users_own_and_known_to_workers(tmp_path, monkeypatch):
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/given")
    assert str(use_cache()) == "/given"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    own = tmp_path / "rcirl-jax"
    own.mkdir()
    for age in range(4):
        (own / f"program{age}").write_bytes(bytes(10))
        os.utime(own / f"program{age}", (1000 - age, 1000 - age))
    try:
        assert use_cache(most=25) == own
        assert jax.config.jax_compilation_cache_dir == str(own)
        assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(own)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert sorted(x.name for x in own.iterdir()) == ["program0", "program1"]
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(own / "program0"))  # no folder
    assert use_cache() is None
