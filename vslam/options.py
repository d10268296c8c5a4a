"""Which values of an option this version has; what is not built is refused in one sentence."""

from __future__ import annotations

from vslam.errors import InputError

SENSORS = {"stereo": True, "mono": True, "rgbd": False}


def require_built(option: str, value: str, known: dict[str, bool]) -> None:
    """Refuse a value that is unknown or not built.

    Raises:
        InputError: the sentence for the user.
    """
    built = ", ".join(f"'{name}'" for name, is_built in known.items() if is_built)
    if value not in known:
        raise InputError(f"{option} {value}: unknown; this version has only {built}.")
    if not known[value]:
        raise InputError(f"{option} {value}: not built yet; this version has only {built}.")
