"""`report`: a recording, a fit, a critique, a fleet or several of them on one page."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, TypeAlias

import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.comparison.compare import Comparison
from allanjax.comparison.specification import SpecLike, check_spec
from allanjax.critic.critique import critique as criticize
from allanjax.critic.result import Critique
from allanjax.estimate.fit import fit
from allanjax.estimate.result import Fit
from allanjax.fleet.fleet import FleetResult
from allanjax.presentation.page import sections
from allanjax.presentation.page.blocks import Section
from allanjax.presentation.page.page import Page, page_of
from allanjax.presentation.page.sections import Reported
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Recording
from allanjax.spectrum.psd import power_spectrum

#: What a page can be about.
Reportable: TypeAlias = Fit | Critique | FleetResult | Comparison | RecordingLike


def report(
    data: Reportable | Sequence[Reportable],
    path: str | os.PathLike[str] | None = None,
    *,
    critique: Critique | None = None,
    recording: Recording | None = None,
    title: str | None = None,
    notes: Mapping[str, str] | None = None,
    spec: SpecLike | None = None,
    pages: Mapping[str, str] | None = None,
) -> Page:
    """Make one self-contained page of HTML, which opens without a network and prints to PDF.

    The page has the verdict with what was found, the conditions, the coefficients with intervals, limits with
    margins, interactive Allan deviations and spectra, the record over time, residuals, the findings of a
    critique with their evidence, the predicted drift, exports, the method with definitions, and how it was
    made. On paper it has what a customer keeps, on two or three sheets for six axes. In a notebook it is
    shown inline.

    Args:
        data: a fit; a critique with the fit that it started from; a recording, which is fitted and criticized
            first; a fleet; a comparison; or several of these, one below the other.
        path: a file to write the page to, with the suffix .html.
        critique: the critique of a fit's recording.
        recording: the recording of a fit, for its spectrum and the samples over time.
        title: heading of the page; by default the recording's name.
        notes: conditions of the records by name, e.g. {"serial number": "0123", "operator": "A. Smith"}.
        spec: a specification, against which each recording is checked, see `check_spec`.
        pages: addresses of the pages of a fleet's units by the units' names.

    Raises:
        AllanjaxError: nothing to show, the file is not named .html, or the specification cannot be read.
        UnitError: a unit of the specification has another dimension.
    """
    kinds = Fit | Critique | FleetResult | Comparison | Recording | str | os.PathLike
    several = isinstance(data, list | tuple) and all(isinstance(one, kinds) for one in data)
    every: Any = data if several else [data]
    parts, names = list[Reported](), list[str]()
    shown = list[Section]()
    for one in every:
        if isinstance(one, FleetResult):
            shown += sections.of_fleet(one, pages or {})
            names.append("Fleet")
        elif isinstance(one, Comparison):
            shown += sections.of_comparison(one)
            names.append(" – ".join(one.labels))
        else:
            part = _parts(one, critique, recording)
            judged = None if spec is None else check_spec(part.fit, spec)
            parts.append(part._replace(limits=judged, conditions=notes or {}))
    page = page_about(parts, title or ", ".join(names), shown)
    if path is not None:
        page.save(path)
    return page


def _parts(data: Any, critique: Critique | None, recording: Recording | None) -> Reported:
    """What is shown of a fit, a critique or a recording."""
    if isinstance(data, Critique):
        return Reported(data.fit, data, recording)
    if isinstance(data, Fit):
        return Reported(data, critique, recording)
    recording = as_recording(data)
    return Reported(fit(recording), criticize(recording), recording)


def page_about(parts: Sequence[Reported], title: str | None = None, first: Sequence[Section] = ()) -> Page:
    """The page about these recordings, with other sections above.

    Raises:
        AllanjaxError: nothing to show.
    """
    shown, names = list(first), ", ".join(dict.fromkeys(one.fit.name for one in parts if one.fit.name))
    for one in parts:
        prefix = f"{one.fit.name}: " if len(parts) > 1 else ""
        own = sections.of_record(_complete(one))
        shown += [dataclasses.replace(section, title=prefix + section.title) for section in own]
    if not shown:
        raise AllanjaxError("nothing to report: give a recording, a fit, a critique or a fleet")
    return page_of(title or names or "Report", shown)


def _complete(one: Reported) -> Reported:
    """With what the record states, and with the samples and the spectrum if there are samples."""
    recording, critique = one.recording, one.critique
    spectrum, known = one.spectrum, dict(one.conditions)
    if recording is not None:
        known |= _stated(recording)
    if critique is not None and (recording is None or recording.duration != critique.duration):
        # Places of findings are those in the part that was criticized.
        recording = critique.recording()
    if spectrum is None and recording is not None:
        spectrum = power_spectrum(recording)
    return one._replace(recording=recording, spectrum=spectrum, conditions=known)


def _stated(recording: Recording) -> Iterator[tuple[str, str]]:
    """Start and temperatures of a record, with their units."""
    if recording.begun is not None:
        yield "start", f"{datetime.fromtimestamp(recording.begun, UTC):%Y-%m-%d %H:%M:%S} UTC"
    for name, values in recording.auxiliary.items():
        if "temp" in name.casefold() and np.isfinite(values).any():
            ends = " … ".join(plain(float(end), 3) for end in (np.nanmin(values), np.nanmax(values)))
            unit = recording.auxiliary_units.get(name)
            yield f"{name} [{unit}]" if unit else name, ends
