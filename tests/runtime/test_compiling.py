"""Seconds of compilations: of all programs, or of one by its name."""

import jax
import jax.numpy as jnp

from rcirl_jax.runtime import compiling
from rcirl_jax.runtime.compiling import compiles


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


def test_wide_vectors_are_asked_for_where_xla_knows_them(monkeypatch):
    unknown = {"xla_cpu_no_such_option": 1}
    for options, wanted in ((compiling.WIDE, compiling.WIDE), (unknown, None)):
        monkeypatch.setattr(compiling, "WIDE", options)
        compiling.wide_vectors.cache_clear()
        try:
            assert compiling.wide_vectors() == wanted
        finally:
            compiling.wide_vectors.cache_clear()
