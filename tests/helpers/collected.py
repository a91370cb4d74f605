"""How many tests pytest would run, of several commands by one collection.

    python -m tests.helpers.collected < commands.json

The commands, lists of words without options but files and -k, come in as JSON; their
numbers of tests go out in their order.
"""

import contextlib
import json
import os
import sys

import pytest
from _pytest.mark import Expression, KeywordMatcher


class Collected:
    """Keeps the tests of a collection."""

    def pytest_collection_finish(self, session):
        self.items = session.items


def counts(commands):
    """Numbers of tests, by pytest's own matching of -k."""
    plugin = Collected()
    files = sorted({x for words in commands for x in words if x.endswith(".py")})
    options = ("--collect-only", "-q", "-p", "no:cacheprovider")
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        assert pytest.main([*options, *files], plugins=[plugin]) == 0
    return [count(plugin.items, words) for words in commands]


def count(items, words):
    """Of one command."""
    chosen = words[words.index("-k") + 1] if "-k" in words else ""
    wanted = Expression.compile(chosen) if chosen else None
    return sum(
        item.nodeid.split("::")[0] in words
        and (wanted is None or wanted.evaluate(KeywordMatcher.from_item(item)))
        for item in items
    )


if __name__ == "__main__":
    print(json.dumps(counts(json.load(sys.stdin))))
