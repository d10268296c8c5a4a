"""Runs a command of vslam in a child process, which ends when its parent process ends.

The child process is started with ``python -m vslam_lab.cli.child run ...``. Its standard input is a
pipe from the parent process, which closes when the parent ends, even if the parent is killed.
"""

from __future__ import annotations

import os
import threading


def _end_with_parent() -> None:
    while os.read(0, 1):  # sys.stdin would hold a lock when the interpreter ends
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from vslam.cli.main import main

    main()
