"""`report`: a recording, a fit, a critique or several of them on one page."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from allanjax.base.errors import AllanjaxError
from allanjax.critic.critique import critique as criticize
from allanjax.critic.result import Critique
from allanjax.estimate.fit import fit
from allanjax.estimate.result import Fit
from allanjax.fleet.fleet import FleetResult
from allanjax.presentation.page import sections
from allanjax.presentation.page.blocks import Section
from allanjax.presentation.page.page import Page, page_of
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Recording
from allanjax.spectrum.psd import PowerSpectrum, power_spectrum

#: What a page can be about.
Reportable: TypeAlias = Fit | Critique | FleetResult | RecordingLike


def report(
    data: Reportable | Sequence[Reportable],
    path: str | os.PathLike[str] | None = None,
    *,
    critique: Critique | None = None,
    recording: Recording | None = None,
    spectrum: PowerSpectrum | None = None,
    title: str | None = None,
    origin: Mapping[str, str] | None = None,
) -> Page:
    """Make one self-contained page of HTML, which opens without a network and prints to PDF.

    The page has the verdict, the coefficients with intervals, interactive Allan deviations and spectra, the
    record over time, residuals, the findings of a critique with their evidence, the predicted drift, exports,
    and how it was made. In a notebook it is shown inline.

    Args:
        data: a fit; a critique with the fit that it started from; a recording, which is fitted and criticized
            first; a fleet; or several of these, one below the other.
        path: a file to write the page to, with the suffix .html.
        critique: the critique of a fit's recording.
        recording: the recording of a fit, for its spectrum and the samples over time.
        spectrum: its spectrum, if it was computed before.
        title: heading of the page; by default the recording's name.
        origin: what to state about the origin of the data, e.g. {"file": "imu.csv"}.

    Raises:
        AllanjaxError: nothing to show, or the file is not named .html.
    """
    kinds = Fit | Critique | FleetResult | Recording | str | os.PathLike
    several = isinstance(data, list | tuple) and all(isinstance(one, kinds) for one in data)
    every: list[Any] = list(data) if several else [data]  # type: ignore[arg-type]
    if not every:
        raise AllanjaxError("nothing to report: give a recording, a fit, a critique or a fleet")
    given = (critique, recording, spectrum)
    made = [_sections(one, *given, origin or {}, len(every) > 1) for one in every]
    names = ", ".join(dict.fromkeys(name for name, _ in made if name))
    page = page_of(title or names or "Report", [section for _, own in made for section in own])
    if path is not None:
        page.save(path)
    return page


def _sections(
    data: Any,
    critique: Critique | None,
    recording: Recording | None,
    spectrum: PowerSpectrum | None,
    origin: Mapping[str, str],
    is_one_of_many: bool,
) -> tuple[str, list[Section]]:
    """Name and sections of one result."""
    if isinstance(data, FleetResult):
        from allanjax.presentation.page.fleet import of_fleet

        return "Fleet", list(of_fleet(data))
    if isinstance(data, Critique):
        critique, data = data, data.fit
    if not isinstance(data, Fit):
        recording = as_recording(data)
        data, critique = fit(recording), criticize(recording)
    if recording is None and critique is not None:
        recording = critique.recording()
    if spectrum is None and recording is not None:
        spectrum = power_spectrum(recording)
    prefix = f"{data.name}: " if is_one_of_many else ""
    return data.name, list(sections.of_record(data, recording, spectrum, critique, origin, prefix))
