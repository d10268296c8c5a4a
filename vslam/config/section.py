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
        return model.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what} ({error.strerror}).") from error
    except ValidationError as error:
        first = error.errors()[0]
        if not first["loc"]:
            raise InputError(f"{path}: the {what} is no JSON object; correct the file.") from error
        *place, key = map(str, first["loc"])
        why = plain_reason(first["msg"])
        if first["type"] == "extra_forbidden":
            why = f"unknown key{did_you_mean(key, _keys(model, place))}; correct or remove it"
        raise InputError(f"{path}: {'.'.join((*place, key))}: {why}.") from error


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
