"""One table: every rule that the code names and every refusal that it can utter is in it, and all that is in it is named by the code."""

import ast
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from slam_backend.core.firewall import rules
from slam_backend.core.firewall.rules import RULES, rule_of
from slam_backend.lab.firewall import STAGES as PAGE

PACKAGE = Path(__file__).parents[3] / "slam_backend"
CORE = PACKAGE / "core"
SOURCE = "\n".join(
    path.read_text()
    for path in (*PACKAGE.rglob("core/**/*.py"), PACKAGE / "io/cdr.py")
    if path != Path(rules.__file__)
)
FILES = [
    *sorted(CORE.glob("sensors/*.py")), *sorted(CORE.glob("firewall/*.py")), *sorted(CORE.glob("association/*.py")),
    *(CORE / name for name in ("beside.py", "budget.py", "calibration.py", "check.py", "coast.py", "context.py", "growth.py",
                               "inertial.py", "quarantine.py", "settle.py", "splitting.py", "waiting.py", "robust/doubt.py")),
]  # fmt: skip
# Whoever is called to refuse -> where verdict, stage and reason stand among the arguments. A text is the stage itself;
# None: there is no verdict but to refuse, or the stage is that of the file. `decided` needs no look: it takes its words from the table.
FORMS = {
    "Unusable": (None, None, 0),
    "Fault": (None, "check", 0),
    "refusal": (None, 1, 2),
    "Decision": (3, 4, 5),
    "_refused": (None, None, 1),
    "_refusal": (None, None, 2),
    "_told": (1, None, 2),
    "told": (1, None, 2),
    "_decision": (1, None, 2),
}
OF_FILE = {
    "relative.py": "relative", "growth.py": "relative", "tag.py": "landmark", "landmark.py": "landmark", "pixels.py": "pixels",
    "splitting.py": "landmark", "tracks.py": "pixels", "associator.py": "association", "doubt.py": "doubt", "budget.py": "budget", "context.py": "*",
}  # fmt: skip
TABLES = {  # dictionaries whose keys are reasons that a variable hands on
    ("tracks.py", "REASONS"): ("pixels", "points"),
    ("pixels.py", "said"): ("pixels",),
    ("quarantine.py", "WHY"): ("quarantine",),
}
NEVER = {  # which of them no code utters in that stage; and what is told of success
    "points/disagrees", "points/second_frame", "placing/placed", "calibration/estimated",
}  # fmt: skip


def refusals(path: Path) -> Iterator[tuple[int, str]]:
    """Line and `stage/reason`; what an f-string leaves open is `*`."""
    tree = ast.parse(path.read_text())
    constants = {
        node.targets[0].id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and isinstance(node.value, ast.Constant)
    }  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            for stage, reason in uttered(node, OF_FILE.get(path.name, ""), constants):
                yield node.lineno, f"{stage}/{reason}"
        for name, value in assigned(node):
            for stage in TABLES.get((path.name, name), ()):
                assert isinstance(value, ast.Dict)
                yield from (
                    (node.lineno, f"{stage}/{reason}") for each in value.keys for reason in texts(each)
                )
            if (path.name, name) == ("ranging.py", "reason"):
                yield from ((node.lineno, f"placing/{reason}") for reason in texts(value))


def uttered(call: ast.Call, stage: str, constants: dict[str, str]) -> Iterator[tuple[str, str]]:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    verdict_at, stage_at, reason_at = FORMS.get(name, (None, None, 99))
    if len(call.args) <= reason_at:
        return
    if verdict_at is not None and set(texts(call.args[verdict_at])) == {"accepted"}:
        return
    if isinstance(stage_at, str):
        stage = stage_at
    elif stage_at is not None:
        said = call.args[stage_at]
        stage = next(texts(said), constants.get(getattr(said, "id", ""), stage))
    for reason in texts(call.args[reason_at]):
        yield stage, reason


def texts(node: ast.AST | None) -> Iterator[str]:
    """What an expression can come to; nothing for what is handed on from elsewhere."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from (*texts(node.body), *texts(node.orelse))
    elif isinstance(node, ast.JoinedStr):
        yield "".join(part.value if isinstance(part, ast.Constant) else "*" for part in node.values)


def assigned(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Names and what is assigned to them, of tuples one by one."""
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
        yield node.target.id, node.value
    if isinstance(node, ast.Assign):
        target, value = node.targets[0], node.value
        pairs = zip(target.elts, value.elts, strict=False) if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) else [(target, value)]  # fmt: skip
        yield from ((one.id, each) for one, each in pairs if isinstance(one, ast.Name))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_refusal_that_the_code_can_utter_has_a_row_with_advice(path: Path) -> None:
    without = [
        f"{path.name}:{line} {id_}"
        for line, id_ in refusals(path)
        if id_ not in NEVER and rule_of(id_) is None and not any(fnmatchcase(row, id_) for row in RULES)
    ]
    assert not without, "add a row to core/firewall/rules.py"
    assert all(rule.what and rule.advice for rule in RULES.values())


def named() -> set[str]:
    """Ids as they stand in the code that judges."""
    found = set(re.findall(r'"((?:check|settle|recheck|wait|imu|gnss|coast|pixels)/[a-z_]+)"', SOURCE))
    found |= {f"check/{reason}" for reason in re.findall(r'Fault\(\s*"([a-z_]+)"', SOURCE)}
    for what in re.findall(r'Fault\(\s*f"\{what\}_([a-z_]+)"', SOURCE):
        found |= {f"check/covariance_{what}", f"check/information_{what}"}
    found |= {
        f"check/{note}"
        for note in re.findall(r'"(zero_covariance|covariance_swapped|covariance_capped)"', SOURCE)
    }
    found |= {f"doubt/{reason}" for reason in re.findall(r'"(unexpected|alone)"', SOURCE)}
    found |= {f"decode/{reason}" for reason in re.findall(r'"(bad_message|unknown_type|oversize)"', SOURCE)}
    return found | {
        f"*/{reason}" for reason in re.findall(r'"(unknown_frame|uncovered|no_camera|off_keyframe)"', SOURCE)
    }


def test_the_table_and_the_code_name_the_same_rules() -> None:
    uttered = {id_ for path in FILES for _, id_ in refusals(path)} - NEVER
    assert set(RULES) == named() | {id_ for id_ in uttered if id_ in RULES}
    assert named() <= set(RULES)


def test_the_walk_finds_what_is_there(tmp_path: Path) -> None:
    """In the files as they are, and what somebody might add."""
    found = {id_ for path in FILES for _, id_ in refusals(path)}
    assert found >= {
        "landmark/steep", "landmark/range", "placing/ambiguous", "pixels/raw_stereo", "pixels/twice", "points/behind", "wait/undetermined",
        "association/nameless", "association/ambiguous", "quarantine/moved", "calibration/unobservable", "doubt/alone",
        "check/off_earth", "check/*_indefinite", "budget/dropped", "*/unknown_frame", "relative/overlap",
    }  # fmt: skip
    new = tmp_path / "tag.py"
    new.write_text('raise Unusable("upside_down", "the tag hangs from its feet")\n')
    assert list(refusals(new)) == [(1, "landmark/upside_down")]
    assert rule_of("landmark/upside_down") is None


def test_every_stage_of_the_table_is_on_the_page() -> None:
    assert {id_.partition("/")[0] for id_ in RULES} == set(PAGE)
