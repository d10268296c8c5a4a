"""``python -m vslam``."""

from vslam.cli import main

if __name__ == "__main__":
    main()
