"""Progress bars are for people: nothing of them in a log file."""

import ast
from pathlib import Path

import tofcorr


def test_no_progress_bar_is_drawn_where_stderr_is_not_a_terminal() -> None:
    # tqdm asks the stream itself if, and only if, `disable=None` is passed.
    calls = [
        (path.name, node.lineno, {word.arg: word.value for word in node.keywords})
        for path in Path(tofcorr.__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "tqdm"
    ]
    assert calls
    for name, line, words in calls:
        disable = words.get("disable", ast.Constant("left out"))
        assert ast.unparse(disable) == "None", f"{name}:{line}"
