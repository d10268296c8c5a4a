"""What all sections of the configuration have in common."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from vslam.errors import InputError, did_you_mean, plain_reason

_Model = TypeVar("_Model", bound=BaseModel)


class Section(BaseModel):
    """A frozen group of thresholds; the docstring below each field describes it.

    ``tools/threshold_table.py`` reads these docstrings from the source. Pydantic could do so itself
    (``use_attribute_docstrings``), but that would take 0.1 s at the start of every run.

    A docstring ends with the source of the value in brackets: [own], or the paper and section of
    the rule and the status of the value: printed there, customary in the programs of the ORB-SLAM
    family, or our own.

    OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017.
    ZS: Zhou and Sun, Sci Rep 15, 7644 (2025).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")


def read_json(model: type[_Model], path: Path, what: str) -> _Model:
    """Read a file of thresholds or settings; keys that it omits keep their defaults.

    Args:
        model: what the file describes.
        path: the file.
        what: a name for its content, for the messages.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what} ({error.strerror}).") from error
    return checked(model, text, str(path), what)


def checked(model: type[_Model], given: object, where: str, what: str) -> _Model:
    """Check thresholds or settings; those that are left out keep their defaults.

    Args:
        model: what they describe.
        given: JSON as bytes, a dictionary, or a model, which is returned as it is.
        where: the file or argument that they come from, for the messages.
        what: a name for them, for the messages.

    Raises:
        InputError: as ``read_json``.
    """
    try:
        if isinstance(given, bytes):
            return model.model_validate_json(given)
        return model.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{where}: {_fault(model, error, what)}.") from None


def _fault(model: type[BaseModel], error: ValidationError, what: str) -> str:
    """What is wrong with the first of the values that are."""
    first = error.errors()[0]
    place = [str(name) for name in first["loc"]]
    if first["type"] == "json_invalid":
        return f"the {what} is not JSON ({first['ctx']['error']}); correct the file"
    if first["type"] == "model_type":
        name = ".".join(place) or f"the {what}"
        return f'{name} must map names to values, as in {{"name": 1}}'
    why = plain_reason(first["msg"])
    if first["type"] in ("extra_forbidden", "invalid_key"):
        meant = did_you_mean(place[-1], _keys(model, place[:-1]))
        why = f"unknown key{meant}; correct or remove it"
    return f"{'.'.join(place)}: {why}"


def _keys(model: type[BaseModel], place: list[str]) -> list[str]:
    """The keys of a section of ``model``; none where a place is no section."""
    for name in place:
        field = model.model_fields.get(name)
        if field is None or not isinstance(field.annotation, type):
            return []
        if not issubclass(field.annotation, BaseModel):
            return []
        model = field.annotation
    return list(model.model_fields)
