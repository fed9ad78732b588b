"""The page of the firewall says what its table holds."""

from pathlib import Path

from slam_backend.core.firewall.rules import RULES
from slam_backend.lab.firewall import page

PAGE = Path(__file__).parents[2] / "docs/firewall.md"


def test_the_page_is_current() -> None:
    assert PAGE.read_text() == page(), "run `make docs`"


def test_every_rule_stands_on_the_page_once() -> None:
    assert all(page().count(f"| `{id_}` |") == 1 for id_ in RULES)
