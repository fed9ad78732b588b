"""The page of settings says what the configuration is."""

from pathlib import Path

from slam_backend.core.config import Config
from slam_backend.lab.settings import page

PAGE = Path(__file__).parents[2] / "docs/settings.md"


def test_the_page_is_current() -> None:
    assert PAGE.read_text() == page(), "run `make docs`"


def test_every_setting_has_a_sentence() -> None:
    assert all(
        f"| `{name}` |" in page() or f"## {name}" in page()
        for name in Config.model_fields
        if name != "sources"
    )
    assert "|  |\n" not in page()
