"""``python -m vslam.cli.child run ...``: the command line of vslam, which ends with its parent.

The parent holds the other end of our standard input. When it is gone, however it went, the pipe
closes: nobody is left to take the results, and the processor is free for the run that replaces us.
"""

from __future__ import annotations

import os
import threading


def _end_with_parent() -> None:
    while os.read(0, 1):  # not sys.stdin: its lock would be held when the interpreter ends
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from vslam.cli.main import main

    main()
