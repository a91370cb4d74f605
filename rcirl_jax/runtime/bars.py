"""A progress bar of work that JAX compiles before its first step."""

import tqdm

NOTE = "compiling first"


class CompilesFirst(tqdm.tqdm):
    """Says why it stands still until the first update; arguments as of tqdm."""

    def __init__(self, **given) -> None:  # noqa: ANN003
        super().__init__(**given)
        self.set_postfix_str(NOTE)

    def update(self, n: float | None = 1) -> bool | None:
        """Count; the note goes."""
        if self.postfix == NOTE:
            self.set_postfix_str("", refresh=False)
        return super().update(n)
