"""What a source imports, read from its text."""

import ast


def imported(source: str) -> set[str]:
    """Return the dotted names that a source imports anywhere, and what it takes from each."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names
