"""Translation of compiled functions to C99, with the same operations in the same order.

A numba function of `njit` becomes a C function; one of `register_jitable` is expanded at its call.
Run this file after a change of these functions: it updates the shipped `wrench_compensator.c.j2`.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drake_teleop.logs.causal import design_low_pass
from drake_teleop.robots import compensation_step as step
from drake_teleop.robots.controller import export
from drake_teleop.robots.streams import NUM_READING_VALUES

TEMPLATE = Path(export.__file__).parent / "templates" / "wrench_compensator.c.j2"

C_HELPER_FUNCTIONS = """\
static int isfinite_(double x) { return x - x == 0.0; }
static int isnan_(double x) { return x != x; }
static double abs_(double x) { return x <= 0.0 ? 0.0 - x : x; }
static double copysign_(double x, double sign) {
  x = abs_(x);
  return sign < 0.0 || (sign == 0.0 && 1.0 / sign < 0.0) ? -x : x;
}
"""
"""C functions that translated code calls; their results are those of Python, except for NaN."""
_HELPER_OF_FUNCTION = {
    math.isfinite: ("isfinite_", "int"),
    math.isnan: ("isnan_", "int"),
    math.copysign: ("copysign_", "double"),
    abs: ("abs_", "double"),
}
_C_OPERATORS: dict[type, tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("+", operator.add),
    ast.Sub: ("-", operator.sub),
    ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv),
    ast.Mod: ("%", operator.mod),
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}


class _CScalar:
    """C expression of a number; `array`: parameter that contains it, or ""; `constant`: fixed."""

    def __init__(self, text: str, kind: str, array: str = "", constant: bool = False) -> None:
        self.text, self.kind, self.array, self.constant = text, kind, array, constant


class _CArray:
    """Pointer in C to elements of the parameter named `array`; sizes are numbers or names."""

    def __init__(self, text: str, shape: tuple[int | str, ...], array: str) -> None:
        self.text, self.shape, self.array = text, shape, array


class Translator:
    """Translator of numba functions to C; called functions come first."""

    def __init__(self) -> None:
        self._functions: dict[tuple[Any, ...], _FunctionTranslation] = {}

    @property
    def text(self) -> str:
        return "\n".join(function.text for function in self._functions.values())

    def translate_function(
        self, function: Any, **parameters: str | tuple[int | str, ...]
    ) -> _FunctionTranslation:
        """Translate a numba function to C.

        `parameters` are its types in order: "double", "int" or the shape of an array, whose first
        size may be a name.
        """
        key = (function, *parameters.items())
        if key not in self._functions:
            uses = sum(known[0] is function for known in self._functions)
            name = function.py_func.__name__ + (f"_{uses + 1}" if uses else "")
            self._functions[key] = _FunctionTranslation(self, function.py_func, name, parameters)
        return self._functions[key]


class _FunctionTranslation:
    def __init__(
        self, translator: Translator, function: Any, name: str, parameters: dict[str, Any]
    ) -> None:
        self._translator, self.name, self.kind = translator, name, "void"
        self.written: set[str] = set()
        self._locals: dict[str, str] = {}
        self._lines: list[str] = []
        self._indent, self._temporaries, self._expanding = 1, 0, False
        tree, self._globals = _parse_source(function)
        names = [argument.arg for argument in tree.args.args]
        if names != list(parameters):
            raise TypeError(f"{name}: the parameters are {names}, not {list(parameters)}")
        self._values: dict[str, Any] = {
            each: _CScalar(each, kind, constant=True)
            if isinstance(kind, str)
            else _CArray(each, kind, each)
            for each, kind in parameters.items()
        }
        self._translate_block(tree.body)
        head = f"static {self.kind} {name}({', '.join(self._declare_parameters(parameters))}) {{"
        comment = (ast.get_docstring(tree) or "").split("\n")[0].replace("`", "")
        body, self._lines = self._lines, [f"/* {comment} */"]
        self._write_line(head, 0)
        for kind in ("int", "double"):
            if names := [each for each, of in self._locals.items() if of == kind]:
                self._write_line(f"{kind} {', '.join(names)};")
        for kind in parameters.values():
            if not isinstance(kind, str) and isinstance(kind[0], str):
                self._write_line(f"(void){kind[0]};")  # it may be unused
        self.text = "\n".join([*self._lines, *body, "}\n"])

    def _declare_parameters(self, parameters: dict[str, Any]) -> list[str]:
        listed = []
        for name, kind in parameters.items():
            if isinstance(kind, str):
                listed.append(f"{kind} {name}")
                continue
            const = "" if name in self.written else "const "
            sizes = "".join(f"[{size}]" for size in kind[1:])
            # The no-break spaces keep a parameter on one line.
            pointer = f"(*{name}){sizes}" if sizes else f"*{name}"
            listed.append(f"{const}double {pointer}".replace(" ", "\xa0"))
            listed += [f"int\xa0{size}" for size in kind if isinstance(size, str)]
        return listed

    def _write_line(self, text: str, indent: int | None = None) -> None:
        pad = "  " * (self._indent if indent is None else indent)
        lines = textwrap.wrap(text, 98, initial_indent=pad, subsequent_indent=pad + "    ")
        self._lines += [line.replace("\xa0", " ") for line in lines]

    def _translate_block(self, body: list[ast.stmt], head: str = "") -> None:
        if head:
            self._write_line(head + " {")
            self._indent += 1
        for node in body:
            self._translate_statement(node)
        if head:
            self._indent -= 1
            self._write_line("}")

    def _translate_statement(self, node: ast.stmt) -> None:
        if isinstance(node, ast.Expr):
            called = self._translate_expression(node.value)
            if isinstance(called, _CScalar):  # neither a docstring nor expanded
                self._write_line(f"{called.text};")
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            self._translate_assignment(node.targets[0], self._translate_expression(node.value))
        elif isinstance(node, ast.AugAssign):
            value = self._translate_operation(node, node.op, node.target, node.value)
            self._translate_assignment(node.target, value)
        elif self._expanding:
            raise self._unsupported_error(node, "only assignments are expanded at a call")
        elif isinstance(node, ast.Return) and node.value is not None:
            value = self._translate_expression(node.value)
            self.kind = _c_type(value)
            self._write_line(f"return {_remove_outer_parentheses(_c_expression(value))};")
        elif isinstance(node, ast.If):
            test = self._translate_expression(node.test)
            if isinstance(test, _CScalar):
                self._translate_block(node.body, f"if ({_remove_outer_parentheses(test.text)})")
                if node.orelse:
                    self._translate_block(node.orelse, "else")
            else:
                self._translate_block(node.body if test else node.orelse)
        elif isinstance(node, ast.For) and isinstance(node.target, ast.Name) and not node.orelse:
            self._translate_loop(node, node.target.id)
        else:
            raise self._unsupported_error(node)

    def _translate_loop(self, node: ast.For, name: str) -> None:
        call, arguments = node.iter, list[ast.expr]()
        if isinstance(call, ast.Call) and self._translate_expression(call.func) is range:
            arguments = call.args
        if len(arguments) not in (1, 2):
            raise self._unsupported_error(call, "a loop needs range(stop) or range(start, stop)")
        limits = [_c_expression(self._translate_expression(argument)) for argument in arguments]
        self._locals[name], self._values[name] = "int", _CScalar(name, "int")
        first, stop = ["0", *limits][-2:]
        self._translate_block(node.body, f"for ({name} = {first}; {name} < {stop}; ++{name})")

    def _translate_assignment(self, target: ast.expr, value: Any) -> None:
        if isinstance(target, ast.Tuple):
            value = self._store_in_variables(value)  # calculated before the first is written
            for each, part in zip(target.elts, value, strict=True):
                self._translate_assignment(each, part)
        elif isinstance(target, ast.Subscript):
            self._write_element(self._translate_expression(target), value)
        elif not isinstance(target, ast.Name):
            raise self._unsupported_error(target)
        elif self._expanding:
            self._values[target.id] = self._store_in_variables(value)
        elif isinstance(value, (tuple, _CArray)):
            if self._indent > 1:
                why = "tuples and arrays cannot be assigned in a branch or loop"
                raise self._unsupported_error(target, why)
            self._values[target.id] = self._store_in_variables(value)
        else:
            if isinstance(self._values.get(target.id), _CScalar) and target.id not in self._locals:
                raise self._unsupported_error(target, "a parameter keeps its value")
            if self._locals.setdefault(target.id, _c_type(value)) != _c_type(value):
                raise self._unsupported_error(target, "a variable keeps its type")
            self._values[target.id] = _CScalar(target.id, _c_type(value))
            self._write_line(f"{target.id} = {_remove_outer_parentheses(_c_expression(value))};")

    def _write_element(self, place: Any, value: Any) -> None:
        self.written.add(place.array)
        if isinstance(place, _CScalar):
            self._write_line(f"{place.text} = {_remove_outer_parentheses(_c_expression(value))};")
            return
        k = self._new_local("int")
        source = f"{value.text}[{k}]" if isinstance(value, _CArray) else _c_expression(value)
        head = f"for ({k} = 0; {k} < {place.shape[0]}; ++{k})"
        self._write_line(f"{head} {place.text}[{k}] = {source};")

    def _store_in_variables(self, value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(self._store_in_variables, value))
        if not isinstance(value, _CScalar) or value.constant:
            return value
        name = self._new_local(value.kind)
        self._write_line(f"{name} = {_remove_outer_parentheses(value.text)};")
        return _CScalar(name, value.kind, constant=True)

    def _new_local(self, kind: str) -> str:
        name = f"{kind[0]}{self._temporaries}_"
        self._temporaries += 1
        self._locals[name] = kind
        return name

    def _translate_expression(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return self._values[node.id] if node.id in self._values else self._globals[node.id]
        if isinstance(node, ast.Attribute):
            return getattr(self._translate_expression(node.value), node.attr)
        if isinstance(node, ast.Tuple):
            return tuple(map(self._translate_expression, node.elts))
        if isinstance(node, ast.Subscript):
            return self._translate_subscript(self._translate_expression(node.value), node.slice)
        if isinstance(node, ast.Call) and not node.keywords:
            return self._translate_call(
                self._translate_expression(node.func),
                [self._translate_expression(each) for each in node.args],
            )
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not)):
            value = self._translate_expression(node.operand)
            negative = isinstance(node.op, ast.USub)
            if not isinstance(value, _CScalar):
                return -value if negative else not value
            kind = value.kind if negative else "int"
            return _CScalar(f"({'-' if negative else '!'}{value.text})", kind)
        if isinstance(node, ast.BinOp):
            return self._translate_operation(node, node.op, node.left, node.right)
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            return self._translate_operation(node, node.ops[0], node.left, node.comparators[0])
        if isinstance(node, ast.BoolOp):
            sign = " && " if isinstance(node.op, ast.And) else " || "
            parts = [_c_expression(self._translate_expression(each)) for each in node.values]
            return _CScalar(f"({sign.join(parts)})", "int")
        raise self._unsupported_error(node)

    def _translate_operation(
        self, node: ast.AST, op: ast.AST, left: ast.expr, right: ast.expr
    ) -> Any:
        a, b = self._translate_expression(left), self._translate_expression(right)
        if type(op) not in _C_OPERATORS:
            raise self._unsupported_error(node)
        sign, calculate = _C_OPERATORS[type(op)]
        if not isinstance(a, _CScalar) and not isinstance(b, _CScalar):
            return calculate(a, b)
        kinds = {_c_type(a), _c_type(b)}
        needed = {"%": {"int"}, "/": {"double"}}.get(sign, kinds)
        if kinds != needed:
            raise self._unsupported_error(node, f"{sign} is allowed only for {' '.join(needed)}")
        kind = "int" if isinstance(op, ast.cmpop) or kinds == {"int"} else "double"
        return _CScalar(f"({_c_expression(a)} {sign} {_c_expression(b)})", kind)

    def _translate_subscript(self, value: Any, node: ast.expr) -> Any:
        if isinstance(node, ast.Tuple):
            for each in node.elts:
                value = self._translate_subscript(value, each)
            return value
        if isinstance(node, ast.Slice):
            start = 0 if node.lower is None else self._translate_expression(node.lower)
            stop = value.shape[0] if node.upper is None else self._translate_expression(node.upper)
            if node.step is not None or not isinstance(start, int) or not isinstance(stop, int):
                raise self._unsupported_error(node)
            text = f"({value.text} + {start})" if start else value.text
            return _CArray(text, (stop - start, *value.shape[1:]), value.array)
        index = self._translate_expression(node)
        if not isinstance(value, _CArray):
            return value[index]
        text = f"{value.text}[{_remove_outer_parentheses(_c_expression(index))}]"
        if value.shape[1:]:
            return _CArray(text, value.shape[1:], value.array)
        return _CScalar(text, "double", value.array)

    def _translate_call(self, function: Any, values: list[Any]) -> Any:
        if function is len and isinstance(values[0], _CArray):
            size = values[0].shape[0]
            return size if isinstance(size, int) else _CScalar(size, "int", constant=True)
        if function in _HELPER_OF_FUNCTION:
            name, kind = _HELPER_OF_FUNCTION[function]
            return _CScalar(f"{name}({', '.join(map(_c_expression, values))})", kind)
        if hasattr(function, "py_func"):
            return self._translate_c_call(function, values)
        if inspect.isfunction(function):
            return self._expand_call(function, values)
        raise ValueError(f"{self.name}: a call of {function!r} cannot be translated to C")

    def _translate_c_call(self, function: Any, values: list[Any]) -> _CScalar:
        given = dict(zip(inspect.signature(function.py_func).parameters, values, strict=True))
        kinds = {
            name: value.shape if isinstance(value, _CArray) else _c_type(value)
            for name, value in given.items()
        }
        called = self._translator.translate_function(function, **kinds)
        passed = []
        for name, value in given.items():
            passed.append(_remove_outer_parentheses(_c_expression(value)))
            if isinstance(value, _CArray):
                passed += [size for size in value.shape if isinstance(size, str)]
                if name in called.written:
                    self.written.add(value.array)
        return _CScalar(f"{called.name}({', '.join(passed)})", called.kind)

    def _expand_call(self, function: Any, values: list[Any]) -> Any:
        tree, scope = _parse_source(function)
        outer = self._values, self._globals, self._expanding
        # An element may be read later, because the expanded function writes only at its end.
        values = [
            each if isinstance(each, _CScalar) and each.array else self._store_in_variables(each)
            for each in values
        ]
        names = [argument.arg for argument in tree.args.args]
        self._values, self._globals = dict(zip(names, values, strict=True)), scope
        self._expanding, result = True, None
        *body, last = tree.body
        self._translate_block(body)
        if isinstance(last, ast.Return) and last.value is not None:
            result = self._translate_expression(last.value)
        else:
            self._translate_block([last])
        self._values, self._globals, self._expanding = outer
        return result

    def _unsupported_error(self, node: ast.AST, why: str = "") -> ValueError:
        what = f"{self.name}: {ast.unparse(node)!r} cannot be translated to C"
        return ValueError(f"{what} ({why})" if why else what)


def _parse_source(function: Any) -> tuple[ast.FunctionDef, dict[str, Any]]:
    tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(tree, ast.FunctionDef)
    return tree, vars(builtins) | function.__globals__


def _c_type(value: Any) -> str:
    if isinstance(value, _CScalar):
        return value.kind
    return "double" if isinstance(value, float) else "int"


def _c_expression(value: Any) -> str:
    if isinstance(value, (_CScalar, _CArray)):
        return value.text
    text = repr(float(value)) if isinstance(value, float) else str(int(value))
    return f"({text})" if value < 0 else text


def _remove_outer_parentheses(text: str) -> str:
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1] if text.startswith("(") else text


def kernel_translation() -> str:
    """Return the part of the template `wrench_compensator.c.j2` that is translated from Python."""
    c = Translator()
    values, row, out = (NUM_READING_VALUES,), (NUM_READING_VALUES + 6,), (12,)
    c.translate_function(step.reading_problem, values=values, largest=values, limits=(6,))
    factors = dict.fromkeys(("sigma_weight", "sigma_inertia", "gamma"), "double")
    c.translate_function(step.set_scale_factors_into, **factors, scales=(4,))
    arrays: dict[str, Any] = {"values": values, "gravity": (3,), "offsets": (6,), "phi": (10,)}
    arrays |= {"no_load": (10,), "scales": (4,), "low_pass": ("low_pass_count",)}
    arrays |= {"memory": (2, *out), "rest": (1, *row), "at": "int", "out": out}
    c.translate_function(step.contact_and_scaled_wrench_into, **arrays)
    c.translate_function(step.clip_wrenches, wrenches=out, limits=(6,))
    moments: dict[str, Any] = {"count": "double", "mean": row, "squares": row}
    c.translate_function(step.add_to_statistics, row=row, **moments)
    c.translate_function(step.update_tare_offsets, **moments, noise_limits=(6,), offsets=(6,))
    numbers = dict.fromkeys(("dt", "tangent", "ahead_s"), "double")
    c.translate_function(design_low_pass, **numbers, low_pass=(7,))
    return f"{C_HELPER_FUNCTIONS}\n{c.text}\n"


def with_translation(template: str) -> str:
    """Return the template with the present translation in place of its translated part."""
    head, tail = template.index("static int isfinite_"), template.index("static const double zero")
    return template[:head] + kernel_translation() + template[tail:]


if __name__ == "__main__":
    TEMPLATE.write_text(with_translation(TEMPLATE.read_text()))
