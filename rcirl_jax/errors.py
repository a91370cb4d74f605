"""One error type for bad input: it reads as one clear line, never a traceback.

Library code raises `InputError("FILE: field: value: what was expected")`; the
experiment files turn it into that line on stderr and exit status 2.
"""


class InputError(ValueError):
    """Something the user gave is wrong: file, field, value, expectation.

    The message is a single line. It names the file first, then the field and
    the value that was found, then what was expected instead.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(str(message).split()))
