"""The base of all JSON files that hold results: immutable, with a version, read and written in one
way."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict

from vslam.errors import InputError


class Record(BaseModel):
    """A part of a document; a field that is not known is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Document(Record):
    """A JSON file of results. A subclass sets ``schema_version`` to the version that it reads."""

    schema_version: int

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file that ``to_json`` wrote.

        Raises:
            InputError: the file is missing, damaged or of another version.
        """
        known = cls.model_fields["schema_version"].default
        try:
            content = json.loads(path.read_bytes())
            found = content["schema_version"]
            if found == known:
                return cls.model_validate(content)
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise InputError(f"{path}: missing or damaged; name the folder of a run.") from error
        raise InputError(
            f"{path}: report schema {found}, this version reads {known}; repeat the run with it."
        )

    def to_json(self) -> str:
        """The text of the file."""
        return self.model_dump_json(indent=2) + "\n"
