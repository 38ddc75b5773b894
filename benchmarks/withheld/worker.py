"""A process that diagnoses one recording after another, asked and answering in lines of JSON.

Loading torch takes longer than many a diagnosis, hence one process for many. What the program
prints goes to stderr.
"""

import json
import os
import sys
import time
import traceback


def main() -> None:
    """Answer {"arguments": [...]} with {"seconds", "code", "message"} until the input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import torch

    from tofcorr.cli.main import group

    torch.set_num_threads(1)
    for line in sys.stdin:
        start = time.perf_counter()
        code, message = 0, ""
        try:
            group(json.loads(line)["arguments"], standalone_mode=False)
        except SystemExit as stop:
            code = int(stop.code or 0)
        except Exception as error:  # noqa: BLE001 - every failure of the program under test is a result
            code, message = 1, "".join(traceback.format_exception(error))[-4000:]
        answers.write(
            json.dumps({"seconds": time.perf_counter() - start, "code": code, "message": message})
            + "\n"
        )
        answers.flush()


if __name__ == "__main__":
    main()
