"""Arithmetic in scenario files: a whitelist over Python's own parser.

An expression is parsed, every node is checked against a short list, powers are
bounded, and only then is it compiled; names are looked up in the variables
given and nowhere else. No attributes, subscripts, strings or other calls. By hand,
because simpleeval allows those, bounds neither length nor depth, and finds what is not
allowed only when a case is made.
"""

import ast
import math
from collections.abc import Callable, Mapping

from rcirl_jax.errors import InputError

MAX_LENGTH = 400  # characters of an expression
MAX_EXPONENT = 64.0  # largest |exponent| of a power

CONSTANTS = {"pi": math.pi, "inf": math.inf, "true": 1.0, "false": 0.0}


def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def _where(condition: float, yes: float, no: float) -> float:
    return yes if condition else no


def _power(base: float, exponent: float) -> float:
    if abs(exponent) > MAX_EXPONENT:
        raise ValueError(f"exponent {exponent:g}: expected at most {MAX_EXPONENT:g}")
    return float(base) ** exponent


# name -> (function, fewest and most arguments)
FUNCTIONS: dict[str, tuple[Callable, int, int]] = {
    "min": (min, 2, 8),
    "max": (max, 2, 8),
    "abs": (abs, 1, 1),
    "sqrt": (math.sqrt, 1, 1),
    "sin": (math.sin, 1, 1),
    "cos": (math.cos, 1, 1),
    "tan": (math.tan, 1, 1),
    "atan": (math.atan, 1, 1),
    "exp": (math.exp, 1, 1),
    "log": (math.log, 1, 1),
    "floor": (math.floor, 1, 1),
    "round": (round, 1, 1),
    "clip": (_clip, 3, 3),
    "where": (_where, 3, 3),
}

_ALLOWED = (
    ast.Expression,
    ast.BinOp,
    ast.UnaryOp,
    ast.BoolOp,
    ast.Compare,
    ast.Call,
    ast.Name,
    ast.Load,
    ast.Constant,
    ast.Add,
    ast.Sub,
    ast.Mult,
    ast.Div,
    ast.FloorDiv,
    ast.Mod,
    ast.Pow,
    ast.UAdd,
    ast.USub,
    ast.Not,
    ast.And,
    ast.Or,
    ast.Lt,
    ast.LtE,
    ast.Gt,
    ast.GtE,
    ast.Eq,
    ast.NotEq,
)


class _Bound(ast.NodeTransformer):
    """Powers become calls of the bounded power."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        """Replace `a ** b`."""
        self.generic_visit(node)
        if not isinstance(node.op, ast.Pow):
            return node
        name = ast.Name(id="_power", ctx=ast.Load())
        return ast.Call(func=name, args=[node.left, node.right], keywords=[])


def _number_text(number: float) -> str:
    try:
        return repr(float(number)) if math.isfinite(number) else "inf"
    except OverflowError:
        return "inf"


class Expression:
    """One checked expression; calling it with variables gives a float."""

    def __init__(self, text: str | float | bool, where: str) -> None:
        """Check and compile.

        Args:
          text: the expression, or a plain number.
          where: "FILE: field", for messages.

        Raises:
          InputError: not arithmetic, or something that is not allowed.
        """
        self.text, self.where = str(text), where
        if isinstance(text, bool | int | float):
            self.text = _number_text(text)
        if len(self.text) > MAX_LENGTH:
            raise InputError(f"{where}: {len(self.text)} characters: too long")
        try:
            tree = ast.parse(self.text.strip(), mode="eval")
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(f"{where}: {self.text!r}: not arithmetic") from error
        self.names = frozenset(self._check(tree))
        bounded = ast.fix_missing_locations(_Bound().visit(tree))
        self._code = compile(bounded, "<expression>", "eval")

    def _check(self, tree: ast.Expression) -> list[str]:
        names: list[str] = []
        called = {
            id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)
        }
        for node in ast.walk(tree):
            if not isinstance(node, _ALLOWED):
                raise self._refuse(type(node).__name__)
            if isinstance(node, ast.Constant) and not isinstance(
                node.value, int | float
            ):
                raise self._refuse(f"constant {node.value!r}")
            if isinstance(node, ast.Call):
                self._check_call(node)
            elif isinstance(node, ast.Name) and id(node) not in called:
                names.append(node.id)
        return names

    def _check_call(self, node: ast.Call) -> None:
        name = node.func.id if isinstance(node.func, ast.Name) else "?"
        if name not in FUNCTIONS or node.keywords:
            raise self._refuse(f"call of {name}")
        _, fewest, most = FUNCTIONS[name]
        if not fewest <= len(node.args) <= most:
            raise self._refuse(f"{name} with {len(node.args)} arguments")

    def _refuse(self, what: str) -> InputError:
        return InputError(
            f"{self.where}: {self.text!r}: {what}: expected arithmetic with "
            f"{', '.join(FUNCTIONS)}"
        )

    def __call__(self, variables: Mapping[str, float]) -> float:
        """The value under the variables.

        Raises:
          InputError: an unknown name, or no finite-or-infinite real number.
        """
        try:
            value = float(eval(self._code, _GLOBALS, {**CONSTANTS, **variables}))
        except NameError as error:
            raise InputError(
                f"{self.where}: {self.text!r}: {error}: expected a parameter or a "
                "derived value"
            ) from error
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"{self.where}: {self.text!r}: {error}") from error
        if math.isnan(value):
            raise InputError(f"{self.where}: {self.text!r}: not a number")
        return value


# names an expression can reach: our functions and nothing built in
_GLOBALS = {
    "__builtins__": {},
    "_power": _power,
    **{name: function for name, (function, _, _) in FUNCTIONS.items()},
}
