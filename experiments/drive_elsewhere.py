"""`rcirl drive-elsewhere` as `python -m` from a clone."""

from rcirl_jax.cli.drive_elsewhere import main
from rcirl_jax.cli.flags.common import run

if __name__ == "__main__":
    run(main)
