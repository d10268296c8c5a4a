"""``python -m vslam.cli.child run ...``: the command line of vslam, which ends with its parent.

The parent process holds the other end of our standard input. When it ends, even if it is killed,
the pipe closes, and this process ends because nobody would read its results.
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
