"""Small mistakes in numeric code, one at a time, for `mutants.py`.

They are common ones: a sign, a transposed frame, exchanged arguments, a missing limit. Text,
messages, checks that only raise, declarations of quantities and default values are unchanged,
because their mistakes are not in the numbers.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from itertools import pairwise

_FLIPS = {ast.Lt: "<>", ast.Gt: "><", ast.LtE: ("<=", ">="), ast.GtE: (">=", "<=")}
_FLIPS |= {ast.Eq: ("==", "!="), ast.NotEq: ("!=", "==")}
_OTHERS = {"min": "max", "minimum": "maximum", "argmin": "argmax", "nanmin": "nanmax"}
_OTHERS |= {"floor": "ceil", "sin": "cos"}
_OTHERS |= {other: name for name, other in _OTHERS.items()}
#: Functions for which the order of arguments does not matter, or whose arguments are not numbers.
_ANY_ORDER = {"min", "max", "minimum", "maximum", "hypot", "isclose", "allclose", "array_equal"}
_ANY_ORDER |= {"zip", "isinstance", "getattr", "setattr", "hasattr", "print", "replace", "Cast"}
_NO_NUMBERS = re.compile(r"(Error|Warning)$|^(quantity|choice|field|warn|print|_?refuse.*)$")
_TEXT = re.compile(
    r"^_?(print|draw|write|describe|draft|show|report|plot|say)"
    r"|(_notes|_rows|_report|_text|_figures|_description|_picture|_table)$|^__(str|repr)__$"
)
_MATRIX = re.compile(r"^_?([A-Z]|jacobian|rotation|matrix|axes)")
_LIMIT = re.compile(r"clip|limit|saturat|bounded")
#: Constants outside of this range are guards, for example against a division by zero.
_SMALL, _LARGE = 1e-6, 1e6


@dataclass(frozen=True)
class Mutation:
    """One change of one file.

    Args:
        file: path below the root, with slashes.
        kind: kind of mistake.
        line: line number from 1.
        start, end: replaced bytes of the source.
        new: new content.
    """

    file: str
    kind: str
    line: int
    start: int
    end: int
    new: bytes

    def applied(self, source: bytes) -> bytes:
        """Return the source with the mistake; lines keep their numbers, for compiled code."""
        lost = source[self.start : self.end].count(b"\n") - self.new.count(b"\n")
        return source[: self.start] + self.new + b"\n" * lost + source[self.end :]

    def lines(self, source: bytes) -> tuple[str, str]:
        """Return the changed lines before and after, without indentation."""
        first = source.rfind(b"\n", 0, self.start) + 1
        after = source.find(b"\n", self.end)
        old, new = source[first:after], self.applied(source)
        new = new[first : len(new) - len(source) + after]
        return _stripped(old), _stripped(new)

    def valid(self, source: bytes) -> bool:
        """Return whether the result is Python and another program."""
        try:
            return ast.dump(ast.parse(self.applied(source))) != ast.dump(ast.parse(source))
        except SyntaxError:
            return False


def _stripped(text: bytes) -> str:
    lines = [line.strip() for line in text.decode().splitlines()]
    return "\n".join(line for line in lines if line)


def mutations(file: str, source: bytes) -> list[Mutation]:
    """Return all mutations of a file; a few may not be `valid`."""
    sites = _Sites(file, source)
    sites.visit(ast.parse(source))
    return sites.found


class _Sites(ast.NodeVisitor):
    """Collects the places of mutations; nodes that it does not visit are not numeric code."""

    def __init__(self, file: str, source: bytes) -> None:
        self.file, self.source = file, source
        self.found: list[Mutation] = []
        self._line_starts = [0]
        for line in source.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))
        self._compiled = False

    # Positions.

    def _start(self, node: ast.AST) -> int:
        return self._line_starts[node.lineno - 1] + node.col_offset

    def _end(self, node: ast.AST) -> int:
        return self._line_starts[node.end_lineno - 1] + node.end_col_offset

    def _text(self, node: ast.AST) -> bytes:
        return self.source[self._start(node) : self._end(node)]

    def _replace(self, kind: str, node: ast.AST, new: bytes) -> None:
        self._between(kind, node, self._start(node), self._end(node), new)

    def _between(self, kind: str, node: ast.AST, start: int, end: int, new: bytes) -> None:
        line = self.source.count(b"\n", 0, start) + 1
        self.found.append(Mutation(self.file, kind, line, start, end, new))

    def _operator(self, kind: str, left: ast.AST, right: ast.AST, old: str, new: str) -> None:
        """Replace the operator between two operands."""
        between = self.source[self._end(left) : self._start(right)]
        if b"#" not in between and old.encode() in between:
            start = self._end(left) + between.index(old.encode())
            self._between(kind, right, start, start + len(old), new.encode())

    def _exchange(self, kind: str, first: ast.AST, second: ast.AST) -> None:
        middle = self.source[self._end(first) : self._start(second)]
        new = self._text(second) + middle + self._text(first)
        self._between(kind, first, self._start(first), self._end(second), new)

    # Unchanged nodes.

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for child in node.body:
            if isinstance(child, ast.FunctionDef):
                self.visit(child)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if _TEXT.search(node.name):
            return
        outside = self._compiled
        self._compiled = outside or any("njit" in ast.unparse(d) for d in node.decorator_list)
        for child in node.body:
            self.visit(child)
        self._compiled = outside

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_If(self, node: ast.If) -> None:
        if not isinstance(node.body[0], ast.Raise) and "TYPE_CHECKING" not in ast.dump(node.test):
            self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        pass

    visit_Assert = visit_JoinedStr = visit_Raise

    # Changed nodes.

    def visit_BinOp(self, node: ast.BinOp) -> None:
        left, right, text = node.left, node.right, _has_text(node)
        if not text and not isinstance(left, ast.List | ast.Tuple):
            for old, new in (("+", "-"), ("-", "+")):
                if isinstance(node.op, {"+": ast.Add, "-": ast.Sub}[old]):
                    self._operator("sign", left, right, old, new)
            for old, new in (("*", "/"), ("/", "*")):
                if isinstance(node.op, {"*": ast.Mult, "/": ast.Div}[old]):
                    self._operator("factor", left, right, old, new)
            for side in (left, right):
                if type(side) is ast.Constant and type(side.value) is int and side.value > 0:
                    self._replace("constant", side, b"%d" % (side.value + 1))
        if isinstance(node.op, ast.MatMult):
            self._matrix_product(left, right)
        if (
            isinstance(node.op, ast.Add)
            and isinstance(left, ast.BinOp)
            and isinstance(left.op, ast.Mult)
            and isinstance(left.left, ast.Constant)
            and isinstance(left.right, ast.Name)
            and isinstance(right, ast.Name)
        ):
            self._exchange("transposed", left.right, right)
        self.generic_visit(node)

    def _matrix_product(self, left: ast.AST, right: ast.AST) -> None:
        if isinstance(left, ast.Name | ast.Subscript) and _MATRIX.match(ast.unparse(left)):
            self._replace("transposed", left, self._text(left) + b".T")
        if isinstance(left, ast.Name) and isinstance(right, ast.Name):
            self._exchange("exchanged", left, right)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self._replace("sign", node, b"(" + self._text(node.operand) + b")")
        if isinstance(node.op, ast.Not):
            self._replace("logic", node, b"(" + self._text(node.operand) + b")")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        self._operator("logic", node.values[0], node.values[1], old, new)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        flip = _FLIPS.get(type(node.ops[0]))
        if flip and len(node.ops) == 1 and not _has_text(node):
            self._operator("comparison", node.left, node.comparators[0], *flip)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if _has_text(node):
            return
        for kind, old, new in (("sign", ast.Add, "+-"), ("sign", ast.Sub, "-+")):
            if isinstance(node.op, old):
                self._operator(kind, node.target, node.value, new[0], new[1])
        for kind, old, new in (("factor", ast.Mult, "*/"), ("factor", ast.Div, "/*")):
            if isinstance(node.op, old):
                self._operator(kind, node.target, node.value, new[0], new[1])
        self._replace("statement", node, b"pass")
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        if isinstance(node.targets[0], ast.Subscript) and not _has_text(node):
            self._replace("statement", node, b"pass")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if self._compiled and isinstance(node.value, ast.Call):
            self._replace("statement", node, b"pass")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if type(value) is float and _SMALL <= abs(value) <= _LARGE:
            other = 1.05 if value == 1.5 else value * 0.5
            self._replace("constant", node, repr(other).encode())

    def visit_Subscript(self, node: ast.Subscript) -> None:
        index = node.slice
        if isinstance(index, ast.Constant):
            if type(index.value) is int and not ast.unparse(node.value).endswith("shape"):
                # Another one of the same three.
                other = index.value + (1 if index.value % 3 < 2 else -1)
                self._replace("index", index, b"%d" % other)
        elif isinstance(index, ast.Tuple) and len(index.elts) == 2 and not _has_text(index):
            first, second = index.elts
            slices = [isinstance(element, ast.Slice) for element in index.elts]
            if ast.dump(first) != ast.dump(second) and not any(slices):
                self._exchange("transposed", first, second)
        self.generic_visit(node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if node.attr == "T":
            self._replace("transposed", node, self._text(node.value))
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        function, args = node.func, node.args
        name = function.attr if isinstance(function, ast.Attribute) else ""
        name = function.id if isinstance(function, ast.Name) else name
        if _NO_NUMBERS.search(name):
            return
        if name in _OTHERS:
            start = self._end(function) - len(name)
            kind = "extreme" if name not in ("sin", "cos") else "angle"
            self._between(kind, node, start, self._end(function), _OTHERS[name].encode())
        if name in ("sqrt", "abs") and len(args) == 1:
            self._replace("removed", node, b"(" + self._text(args[0]) + b")")
        if name in ("transpose", "inverse") and not args and isinstance(function, ast.Attribute):
            self._replace("transposed", node, self._text(function.value))
        if name in ("min", "max", "minimum", "maximum") and len(args) == 2:
            kept = args[1] if isinstance(args[0], ast.Constant) else args[0]
            self._replace("limit", node, b"(" + self._text(kept) + b")")
        elif args and _LIMIT.search(name) and (len(args) > 1 or name == "clip"):
            kept = args[0] if len(args) != 2 or isinstance(function, ast.Name) else function.value
            self._replace("limit", node, b"(" + self._text(kept) + b")")
        if name == "range" and len(args) == 1 and _integer(args[0]) > 1:
            self._replace("constant", args[0], b"%d" % (_integer(args[0]) - 1))
        if name not in _ANY_ORDER and not _has_text(node):
            for first, second in pairwise(args):
                if _is_quantity(first) and _is_quantity(second):
                    self._exchange("exchanged", first, second)
        self.generic_visit(node)


def _has_text(node: ast.AST) -> bool:
    return any(isinstance(n, ast.Constant) and isinstance(n.value, str) for n in ast.walk(node))


def _integer(node: ast.AST) -> int:
    return node.value if isinstance(node, ast.Constant) and type(node.value) is int else 0


def _is_quantity(node: ast.AST) -> bool:
    """Return whether the node may be a number or an array that differs between calls."""
    return isinstance(node, ast.Name | ast.Attribute | ast.Subscript | ast.BinOp)
