"""The corrector as C99 source, for robots and controllers without any library."""

from contextlib import ExitStack
from pathlib import Path

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.c_code.compiled import c_compiler, load_c
from tofcorr.correction.export.c_code.source import c_name, c_sources
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError
from tofcorr.files.staged import scratch_folder, staged_file


def export_c(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write source, header and test program, compile them, and compare with the float64 model.

    `NAME.c` gives `NAME_correct(depth, amplitude, corrected, valid)` and `NAME_metadata()`, which
    `NAME.h` declares. `NAME_test.c` is a program that compares both with the model on the machine
    that it runs on. Conditions are taken as the mean of the calibration.

    Args:
        corrector: Where the metadata come from.
        path: The `.c` file to write; the others are put beside it. Older ones are replaced.
        reference: The calibration that it must agree with.

    Raises:
        ConfigError: `path` is no name of a C file, there is no C compiler, or C cannot hold one
            of the terms.
        ExportError: The compiled source differs from the float64 model; nothing is written.
    """
    path = Path(path)
    name = c_name(path.stem)
    if path.suffix != ".c" or name != path.stem:
        raise ConfigError(
            f"{path}: expected a name such as {name}.c, of letters, digits and underscores: the "
            "functions in C are called as the file."
        )
    compiler = c_compiler()
    sources = c_sources(reference, corrector.metadata(), name)
    with ExitStack() as stack:
        staged = {n: stack.enter_context(staged_file(path.with_name(n))) for n in sources}
        work = stack.enter_context(scratch_folder())
        for file_name, text in sources.items():
            (work / file_name).write_text(text, encoding="utf-8")
        require_parity(load_c(work / path.name, compiler=compiler), reference)
        for file_name, text in sources.items():
            staged[file_name].write_text(text, encoding="utf-8")
