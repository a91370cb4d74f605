"""`rcirl export` as `python -m` from a clone."""

from rcirl_jax.cli.export_weights import main
from rcirl_jax.cli.flags.common import run

if __name__ == "__main__":
    run(main)
