"""Figures that a critique has, and their files."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from allanjax.critic.finding import Finding
from allanjax.critic.result import Critique


class Job(NamedTuple):
    """Figure to be drawn: of a finding, None for an axis without; in which axis; if by request only."""

    finding: Finding | None
    axis: str
    is_extra: bool = False

    def is_wanted(self, findings: Collection[Finding] | None) -> bool:
        """Whether it is among the findings that were asked for."""
        return not self.is_extra if findings is None else self.finding in findings


def jobs(critique: Critique) -> list[Job]:
    """Figures of the findings in their order, of axes without, and of what findings of several axes tell."""
    told = critique.findings
    clean = [Job(None, axis.axis.name) for axis in critique.results if not axis.findings]
    extra = [Job(f, f.axes[0], True) for axis in critique.results for f in axis.findings if f not in told]
    return [*(Job(f, f.shown) for f in told), *clean, *extra]


def figure_names(critique: Critique) -> tuple[str, ...]:
    """File names of a critique's figures, numbered where a cause was found several times."""
    return file_names(critique, [job for job in jobs(critique) if not job.is_extra])


def file_names(critique: Critique, jobs: Sequence[Job]) -> tuple[str, ...]:
    """Names after the axis that is shown, or the axes that share what was found, and the cause."""
    names: list[str] = []
    for finding, axis, _ in jobs:
        where = "_".join(finding.axes) if finding in critique.shared_findings and finding else axis
        names.append(where if finding is None else f"{where}_{finding.cause}")
    earlier = [names[:k].count(name) for k, name in enumerate(names)]
    start = critique.name or "recording"
    return tuple(
        f"{start}_{name}{f'_{k + 1}' if k else ''}.png" for name, k in zip(names, earlier, strict=True)
    )
