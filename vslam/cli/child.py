"""``python -m vslam.cli.child run ...``: the command line of vslam, ending with its parent process.

The parent holds the other end of our standard input. When the parent ends, even if it is killed,
the pipe closes. Nobody then reads the results, so this process ends and frees the processor.
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
