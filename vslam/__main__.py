"""Entry point of ``python -m vslam``, which does the same as the command ``vslam``."""

from vslam.cli.main import main

if __name__ == "__main__":
    main()
