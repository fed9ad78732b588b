"""The numbers that people want first."""

from pathlib import Path

from ...core.config import Config, config_to
from ...io.configfile import flat
from .page import Section, said, table
from .subject import Subject


def title(run: Subject) -> str:
    return ", ".join(Path(each).name for each in run.summary["input"])


def section(run: Subject) -> Section:
    told = run.summary
    counts, cost, timing = told["counts"], told["cost"], told["timing"]
    loops = f"{counts['loops_accepted']} of {counts['loops_offered']}"
    cards = {
        "keyframes": f"{counts['keyframes']:,}",
        "landmarks": f"{counts['landmarks']:,}",
        "loops accepted": loops,
        "factors": f"{counts['factors']:,}",
        "cost by odometry alone": f"{cost['initial']:.5g}",
        "cost at the end": f"{cost['final']:.6g}",
        "s to replay": f"{timing['wall_s']:.1f}",
        "ms per update (p50)": f"{timing['update_ms']['p50']:.1f}",
        "MB": f"{told['memory_mb']:.0f}",
    }
    shown = "".join(
        f'<div class="card"><b>{value}</b><span>{name}</span></div>'
        for name, value in cards.items()
        if value not in ("0", "0 of 0")
    )
    facts = [("run hash", told["run_hash"]), ("config hash", told["config_hash"])]
    facts += [(f"version of {name}", value) for name, value in told["versions"].items()]
    body = f'<div class="cards">{shown}</div>'
    body += "".join(said(line) for line in (*told["damage"], *told["notes"]))
    body += "<details><summary>What would have to be equal for an equal run</summary>"
    body += table(("", ""), facts) + said("Settings that differ from their defaults:")
    body += table(("setting", "value"), _differences(run.config)) + "</details>"
    return Section("Summary", body)


def _differences(config: Config) -> list[tuple[str, str]]:
    usual = config_to(Config())
    return [
        (name, str(value)) for name, value in flat(config_to(config)) if value != dict(flat(usual)).get(name)
    ]
