"""What every part of the configuration has."""

from typing import Any

from pydantic import BaseModel, ConfigDict

LIVE: dict[str, Any] = {"live": True}  # settings that a running node takes; all others are read-only there


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
