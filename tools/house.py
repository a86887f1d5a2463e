"""How the program is built, in figures: sizes of functions, helpers with one caller, comments, signatures.

``python -m tools.house`` prints them for the package `acquire`, and ``python -m tools.house DIR`` for another
one, to compare. They are symptoms, not goals: a helper with one caller may be a good paragraph's name, and a
comment noise.

A private function has one caller if its name is referred to once, in its own module, or in the whole package
if it is imported somewhere. The reference may be a call, or hand it over: a callback, or a thread's target.
"""

from __future__ import annotations

import argparse
import ast
import io
import statistics
import tokenize
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

LONG_LINES = 30
MANY_ARGUMENTS = 6
MANY_ATTRIBUTES = 15
Function = ast.FunctionDef | ast.AsyncFunctionDef
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


@dataclass
class Module:
    """A file, and how often it refers to each name."""

    tree: ast.Module
    code: set[int]
    comments: int
    named: Counter[str] = field(default_factory=Counter)
    called: Counter[str] = field(default_factory=Counter)
    imported: set[str] = field(default_factory=set)

    @classmethod
    def read(cls, path: Path) -> Module:
        text = path.read_text(encoding="utf-8")
        tree, tokens = ast.parse(text), list(tokenize.generate_tokens(io.StringIO(text).readline))
        code = {
            line
            for token in tokens
            if token.type not in NO_CODE
            for line in range(token.start[0], token.end[0] + 1)
        }
        for node in ast.walk(tree):
            if isinstance(node, Function | ast.ClassDef | ast.Module) and ast.get_docstring(node) is not None:
                code -= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
        module = cls(tree, code, sum(token.type == tokenize.COMMENT for token in tokens))
        for node in ast.walk(tree):
            if name := _name(node):
                module.named[name] += 1
            elif isinstance(node, ast.Call) and (name := _name(node.func)):
                module.called[name] += 1
            elif isinstance(node, ast.ImportFrom):
                module.imported |= {alias.name for alias in node.names}
        return module

    def all(self, *kinds: type[ast.AST]) -> list[ast.AST]:
        return [node for node in ast.walk(self.tree) if isinstance(node, kinds)]

    @property
    def functions(self) -> list[Function]:
        return [node for node in ast.walk(self.tree) if isinstance(node, Function)]

    def lines(self, function: Function) -> int:
        """Return the number of code lines of a body."""
        return len(self.code & set(range(function.body[0].lineno, (function.end_lineno or 0) + 1)))


def _name(node: ast.AST) -> str:
    """Return the name that an expression refers to; "" for any other node."""
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load) else ""


def one_caller(modules: list[Module]) -> tuple[int, int, int]:
    """Return the number of private functions, of those referred to once, and of those called once."""
    named: Counter[str] = sum((module.named for module in modules), Counter())
    called: Counter[str] = sum((module.called for module in modules), Counter())
    imported = set().union(*(module.imported for module in modules))
    count = once = once_called = 0
    for module in modules:
        defined = Counter(function.name for function in module.functions)
        for function in module.functions:
            name = function.name
            if not name.startswith("_") or name.startswith("__"):
                continue
            count += 1
            # Of functions of the same name, as methods of several classes, it is unknown which one is meant.
            references, calls = (named, called) if name in imported else (module.named, module.called)
            if defined[name] == 1 and references[name] == 1:
                once += 1
                once_called += calls[name]
    return count, once, once_called


def attributes(cls: ast.ClassDef) -> int:
    """Return the number of attributes that a class sets on ``self``, or declares."""
    declared = {
        node.target.id
        for node in cls.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    return len(
        declared
        | {
            node.attr
            for node in ast.walk(cls)
            if isinstance(node, ast.Attribute)
            and isinstance(node.ctx, ast.Store)
            and isinstance(node.value, ast.Name)
            and node.value.id == "self"
        }
    )


def measures(root: Path) -> dict[str, str]:
    """Return what is measured → its figure, in words."""
    files = sorted(root.rglob("*.py"))
    modules = [Module.read(file) for file in files]
    sizes = [module.lines(function) for module in modules for function in module.functions]
    ninth = statistics.quantiles(sizes, n=10)[-1]
    over = sum(size > LONG_LINES for size in sizes)
    private, once, once_called = one_caller(modules)
    classes = [node for m in modules for node in m.all(ast.ClassDef) if isinstance(node, ast.ClassDef)]
    public = [
        node
        for module in modules
        for node in (*module.functions, *module.all(ast.ClassDef))
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_")
    ]
    bare = sum(ast.get_docstring(node) is None for node in public)
    calls = [node for module in modules for node in module.all(ast.Call) if isinstance(node, ast.Call)]
    comments, code = sum(m.comments for m in modules), sum(len(m.code) for m in modules)
    twice = sum(count > 1 for count in Counter(node.name for node in classes).values())
    return {
        "files, functions": f"{len(files)}, {len(sizes)}",
        "code lines per function, median / p90": f"{statistics.median(sizes):.0f} / {ninth:.0f}",
        f"functions of more than {LONG_LINES} lines": _share(over, len(sizes)),
        "private functions referred to once": _share(once, private),
        "of which called, and not handed over": _share(once_called, private),
        "comments per 100 lines of code": f"{100 * comments / code:.1f}",
        "public names without a docstring": _share(bare, len(public)),
        f"calls with {MANY_ARGUMENTS} positional arguments or more": str(
            sum(len(call.args) >= MANY_ARGUMENTS for call in calls)
        ),
        f"classes with {MANY_ATTRIBUTES} attributes or more": str(
            sum(attributes(node) >= MANY_ATTRIBUTES for node in classes)
        ),
        "class names used more than once": str(twice),
    }


def _share(part: int, whole: int) -> str:
    return f"{100 * part / max(whole, 1):.1f} % ({part} of {whole})"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("package", nargs="?", type=Path, default=Path(__file__).parents[1] / "acquire")
    for what, figure in measures(parser.parse_args().package).items():
        print(f"{what:45} {figure}")


if __name__ == "__main__":
    main()
