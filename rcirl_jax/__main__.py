"""`python -m rcirl_jax` is the command `rcirl`."""

from rcirl_jax.cli.rcirl import main

if __name__ == "__main__":
    main()
