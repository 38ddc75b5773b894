"""Which file of the package imports which, read from the source.

An edge is an `import` anywhere in a file: at its top, inside a function (late), or by
`import_module`. Two kinds of import are left out. Those under `if TYPE_CHECKING` never run. The
implicit import of the parent packages (`a` and `a.b` when `a.b.c` is imported) is the same for
all files of a package, and would make a circle of every package that re-exports a name.
"""

import ast
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

Graph = Mapping[str, frozenset[str]]
"""The modules that each module imports, by dotted name."""


def imported(source: str) -> set[str]:
    """Return the dotted names that a source imports anywhere, and what it takes from each."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def import_graph(package: Path = ROOT / "tofcorr") -> dict[str, frozenset[str]]:
    """Return the graph of all files of a package."""
    files = {_dotted(path, package.parent): path for path in sorted(package.rglob("*.py"))}
    nodes = {name: list(_nodes(path.read_text(encoding="utf-8"))) for name, path in files.items()}
    stated = {name: set(_stated(found, files.keys())) - {name} for name, found in nodes.items()}
    named = {name: _strings(found) for name, found in nodes.items()}
    graph = {}
    for name, found in nodes.items():
        # A file that imports by name finds the names in itself or in a registry that it imports.
        strings = named[name].union(*(named[other] for other in stated[name]))
        by_name = set(_by_name(found, strings, files.keys()))
        graph[name] = frozenset((stated[name] | by_name) - {name})
    return graph


def reached_from(start: str, graph: Graph) -> set[str]:
    """Return all modules that a module imports, directly or through others."""
    found: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += graph[name]
    return found


def circles(graph: Graph) -> list[list[str]]:
    """Return the groups of modules that import each other, directly or through others."""
    reached = {name: reached_from(name, graph) for name in graph}
    groups = {
        tuple(sorted(other for other in reached[name] if name in reached[other]))
        for name in graph
        if name in reached[name]
    }
    return sorted(list(group) for group in groups)


def _dotted(path: Path, root: Path) -> str:
    names = path.relative_to(root).with_suffix("").parts
    return ".".join(names[:-1] if names[-1] == "__init__" else names)


def _nodes(text: str) -> Iterator[ast.AST]:
    """Yield all nodes of a file that run, so not those under `if TYPE_CHECKING`."""
    waiting: list[ast.AST] = [ast.parse(text)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
        else:
            yield node
            waiting += ast.iter_child_nodes(node)


def _stated(nodes: Iterable[ast.AST], modules: Collection[str]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module in modules:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in modules else node.module


def _by_name(
    nodes: Iterable[ast.AST], strings: set[str], modules: Collection[str]
) -> Iterator[str]:
    """Yield the modules that calls of `import_module` can load."""
    for node in nodes:
        if not (isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module")):
            continue
        argument, prefix = node.args[0], ""
        if isinstance(argument, ast.JoinedStr) and isinstance(argument.values[0], ast.Constant):
            prefix = str(argument.values[0].value)
        for string in strings:
            for candidate in (string, string.partition(":")[0], f"{string}_"):
                if prefix + candidate in modules:
                    yield prefix + candidate


def _strings(nodes: Iterable[ast.AST]) -> set[str]:
    return {
        node.value
        for node in nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
