"""Conditions on the numbers of a run and of a base, such as `ate > 1.05 * base`: arithmetic and comparisons, nothing else."""

import ast
import operator
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any

from ..core.errors import BadConfig

Numbers = Mapping[str, float | None]

BASE = "base"
LONGEST = 1000  # characters; ast follows nested brackets as deep as they go
ARITHMETIC: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.UAdd: operator.pos, ast.USub: operator.neg, ast.Not: operator.not_,
    ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Lt: operator.lt, ast.LtE: operator.le,
    ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip


class Condition:
    """`base.NAME` is that number of the base; `base` alone is the base's value of the one name in the condition."""

    def __init__(self, text: str, known: Mapping[str, str]) -> None:
        """known: the names that may stand in it, and what they mean. BadConfig says what is wrong with the text."""
        self.text = text
        try:
            self._tree: ast.expr = ast.parse(text.strip()[:LONGEST], mode="eval").body
        except (SyntaxError, ValueError):
            raise self._bad("is no condition; write for instance 'ate > 1.05 * base'") from None
        names = [node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name) and node.id != BASE]
        names += [node.attr for node in ast.walk(self._tree) if isinstance(node, ast.Attribute)]
        self._names = sorted(set(names))
        for name in self._names:
            if name not in known:
                close = get_close_matches(name, known, n=1)
                hint = f"did you mean '{close[0]}'? " if close else ""
                raise self._bad(f"there is no '{name}'; {hint}known: {', '.join(known)}")
        if not isinstance(self._tree, ast.Compare | ast.BoolOp) and not self._negated():
            raise self._bad("compares nothing; write for instance 'ate > 1.05 * base'")
        self._value(self._tree, dict.fromkeys(known, 1.0), dict.fromkeys(known, 1.0))

    def holds(self, numbers: Numbers, base: Numbers) -> bool:
        """BadConfig where a number is not known."""
        return bool(self._value(self._tree, numbers, base))

    def _negated(self) -> bool:
        return isinstance(self._tree, ast.UnaryOp) and isinstance(self._tree.op, ast.Not)

    def _value(self, node: ast.expr, numbers: Numbers, base: Numbers) -> Any:  # noqa: PLR0911  # one for each kind
        def value(inner: ast.expr) -> Any:
            return self._value(inner, numbers, base)

        match node:
            case ast.Constant(value=int() | float() as number):
                return number
            case ast.Name(id=name) if name == BASE:
                return self._number(self._only(), base)
            case ast.Name(id=name):
                return self._number(name, numbers)
            case ast.Attribute(value=ast.Name(id=owner), attr=name) if owner == BASE:
                return self._number(name, base)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in ARITHMETIC:
                try:
                    return ARITHMETIC[type(op)](value(left), value(right))
                except ZeroDivisionError:
                    raise self._bad("divides by zero") from None
            case ast.UnaryOp(op=op, operand=operand) if type(op) in ARITHMETIC:
                return ARITHMETIC[type(op)](value(operand))
            case ast.BoolOp(op=op, values=parts):
                return (all if isinstance(op, ast.And) else any)([value(part) for part in parts])
            case ast.Compare(left=left, ops=ops, comparators=rights) if all(
                type(op) in ARITHMETIC for op in ops
            ):
                values = [value(each) for each in (left, *rights)]
                pairs = zip(ops, values, values[1:], strict=False)
                return all(ARITHMETIC[type(op)](a, b) for op, a, b in pairs)
        raise self._bad(f"'{ast.unparse(node)}' is neither a number, a name, arithmetic nor a comparison")

    def _only(self) -> str:
        if len(self._names) != 1:
            raise self._bad("which number of the base? write for instance base.ate")
        return self._names[0]

    def _number(self, name: str, numbers: Numbers) -> float:
        number = numbers.get(name)
        if number is None:
            raise self._bad(f"'{name}' is not known for these runs (errors need --truth)")
        return number

    def _bad(self, why: str) -> BadConfig:
        return BadConfig(f"--fail-if '{self.text}': {why}")
