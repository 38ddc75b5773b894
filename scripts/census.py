"""Count what a maintainer must hold in mind, and refuse more of it than before.

    python scripts/census.py [FOLDER ...]
    python scripts/census.py --lower

Without folders, the counts are held against the budget in `scripts/census.toml`; `--lower` writes
lower ones there. A count may rise only by a change of that file that says why.

- statements: lines that are no docstring, comment, blank line or import;
- numbers: what one could tune and a caller cannot reach: constants of a module that hold a number,
  and fractions inside functions other than the plainest, written as 0.05 or as 1 / 20;
- records: dataclasses and named tuples;
- single: modules that exactly one other file imports, plug-ins aside: paragraphs of that file.
"""

import ast
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[1]
BUDGET = Path(__file__).with_suffix(".toml")
PLAIN = {0, 1, 2, 3, 4, -1, 0.5, 10, 100, 180, 1000}
PLUG_INS = ("effects", "export", "checks", "forms")
"""Folders whose files are each named by one registry."""


def census(folder: Path) -> dict[str, int]:
    """Return the counts of all Python files of a folder."""
    sources = {path: path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.py"))}
    trees = {path: ast.parse(source) for path, source in sources.items()}
    stubs = [ast.parse(path.read_text(encoding="utf-8")) for path in folder.rglob("*.pyi")]
    imported = Counter(name for tree in (*trees.values(), *stubs) for name in set(_imported(tree)))
    single = [
        path
        for path in trees
        if path.name != "__init__.py"
        and path.parent.name not in PLUG_INS
        and imported[".".join(path.relative_to(folder.parent).with_suffix("").parts)] == 1
    ]
    return {
        "files": len(sources),
        "statements": sum(_statements(sources[path], trees[path]) for path in sources),
        "numbers": sum(_numbers(tree) for tree in trees.values()),
        "records": sum(_records(tree) for tree in trees.values()),
        "single": len(single),
    }


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _statements(source: str, tree: ast.Module) -> int:
    """Count the lines that are no docstring, comment, blank line or import."""
    left_out: set[int] = set()
    for node in ast.walk(tree):
        value = node.value if isinstance(node, ast.Expr) else None
        text = isinstance(value, ast.Constant) and isinstance(value.value, str)
        if text or isinstance(node, ast.Import | ast.ImportFrom):
            assert isinstance(node, ast.stmt)
            left_out.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = enumerate(source.splitlines(), 1)
    return sum(
        number not in left_out and bool(line.strip()) and not line.strip().startswith("#")
        for number, line in lines
    )


def _numbers(tree: ast.Module) -> int:
    """Count constants that hold a number, and fractions in functions."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [name for target in targets for name in ast.walk(target)]
            values = [one for one in ast.walk(node.value) if isinstance(one, ast.Constant)]
            if any(type(one.value) in (int, float) for one in values):
                count += sum(isinstance(n, ast.Name) and n.id.strip("_").isupper() for n in names)
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            inside = [one for part in function.body for one in ast.walk(part)]
            fractions = [one.value for one in inside if isinstance(one, ast.Constant)]
            count += sum(type(one) is float and one not in PLAIN for one in fractions)
            count += sum(_is_quotient(one) for one in inside)
    return count


def _is_quotient(node: ast.AST) -> bool:
    """Whether a node is one whole number over another."""
    return (
        isinstance(node, ast.BinOp)
        and isinstance(node.op, ast.Div)
        and all(isinstance(one, ast.Constant) for one in (node.left, node.right))
    )


def _records(tree: ast.Module) -> int:
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    return sum(
        any("dataclass" in ast.unparse(one) for one in node.decorator_list)
        or any(ast.unparse(base).endswith("NamedTuple") for base in node.bases)
        for node in classes
    )


def excess(counts: dict[str, dict[str, int]], budget: dict[str, dict[str, int]]) -> list[str]:
    """Return a sentence for every count above its budget."""
    return [
        f"{folder} has {counts[folder][name]} {name}, {most} were there before: make it smaller, "
        "or say in scripts/census.toml why it grew"
        for folder, own in budget.items()
        for name, most in own.items()
        if counts[folder][name] > most
    ]


@click.command()
@click.argument("folders", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--lower", is_flag=True, help="Write counts that have fallen as the new budget.")
def main(folders: tuple[Path, ...], lower: bool) -> None:
    """Count statements, numbers, records and files."""
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8"))
    counts = {str(one): census(ROOT / one) for one in folders or map(Path, budget)}
    for folder, own in counts.items():
        click.echo(f"{folder}: " + ", ".join(f"{count} {name}" for name, count in own.items()))
    if folders:
        return
    if lower:
        head = [line for line in BUDGET.read_text().splitlines() if line.startswith("#")]
        for folder, own in budget.items():
            head += ["", f"[{folder}]"]
            head += [f"{name} = {min(most, counts[folder][name])}" for name, most in own.items()]
        BUDGET.write_text("\n".join(head) + "\n", encoding="utf-8")
    if said := excess(counts, budget):
        raise click.ClickException("\n".join(said))


if __name__ == "__main__":
    main()
