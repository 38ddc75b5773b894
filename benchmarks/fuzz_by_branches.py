"""Fuzzing led by the branches that an input reaches: libFuzzer draws for Hypothesis, by atheris.

    python -m benchmarks.fuzz_by_branches frames.csv --count 100000 --seed 1

Needs `pip install tofcorr[fuzz]` (Python 3.11 to 3.13, Linux). It stops at the first failure.
What is mutated, and what counts as a failure, is said in `benchmarks.fuzz`.
"""

import sys
import tempfile
from pathlib import Path

import atheris  # type: ignore[import-not-found]
import click
import hypothesis

with atheris.instrument_imports(include=["tofcorr"]):  # type: ignore[attr-defined]
    from benchmarks.fuzz import all_targets, mutated, outcome


@click.command()
@click.argument("name")
@click.option("--count", default=100_000, show_default=True, help="Number of inputs.")
@click.option("--seed", default=1, show_default=True)
def main(name: str, count: int, seed: int) -> None:
    """Mutate one file, read it, and count the branches."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        target = next(one for one in all_targets(place / "valid", seed) if one.name == name)

        @hypothesis.given(mutated(target))
        def test(content: bytes) -> None:
            kind, where = outcome(target, place / "inputs", content)
            assert not where, f"{name}: {kind}: {where}"

        limits = ("-timeout=20", "-rss_limit_mb=2048", "-max_len=8192", "-len_control=0")
        atheris.Setup(
            [sys.argv[0], f"-runs={count}", f"-seed={seed}", *limits],
            lambda data: test.hypothesis.fuzz_one_input(data) and None,  # pyright: ignore
        )
        atheris.Fuzz()


if __name__ == "__main__":
    main()
