"""`rcirl human-likeness` as `python -m` from a clone."""

from rcirl_jax.cli.flags.common import run
from rcirl_jax.cli.human_likeness import main

if __name__ == "__main__":
    run(main)
