"""Presentation of results to people: figures, tables, stories and files.

Importing this room gives results their methods that draw, tell and export (see `base.late`).
"""

from allanjax.base.late import present

present(
    {
        "AllanDeviation.plot": "allanjax.report.allan_figure.plot_allan",
        "Autocorrelation.plot": "allanjax.report.spectrum_figure.plot_autocorrelation",
        "AxisPosterior.plot_corner": "allanjax.report.posterior_figure.plot_corner",
        "BiasTracks.plot": "allanjax.report.navigation_figure.plot_bias_tracks",
        "Calibration.plot": "allanjax.report.navigation_figure.plot_calibration",
        "Critique.__str__": "allanjax.report.critique_story.story",
        "Critique.details": "allanjax.report.critique_story.details",
        "Critique.plot": "allanjax.report.critique_figure.plot_critique",
        "Critique.to_dict": "allanjax.report.critique_json.to_dict",
        "Finding.__repr__": "allanjax.report.critique_story.finding_repr",
        "Finding.__str__": "allanjax.report.critique_story.finding_text",
        "Fit.plot": "allanjax.report.allan_figure.plot_allan",
        "Fit.to_dict": "allanjax.estimate.as_json.to_dict",
        "FleetResult.plot": "allanjax.report.fleet_figure.plot_fleet",
        "Navigation.plot": "allanjax.report.navigation_figure.plot_navigation",
        "Posterior.plot": "allanjax.report.posterior_figure.plot_posterior",
        "Recording.from_dataframe": "allanjax.record.io.given.as_recording",
        "PowerSpectrum.plot": "allanjax.report.spectrum_figure.plot_spectrum",
        "SampleRates.plot": "allanjax.report.allan_figure.plot_sample_rates",
        "StateSpace.to_c_header": "allanjax.report.files.to_c_header",
        "StateSpace.to_matlab": "allanjax.report.files.to_matlab",
        "StateSpace.to_numpy": "allanjax.report.files.to_numpy",
        "WaveletDecomposition.plot": "allanjax.report.spectrum_figure.plot_decomposition",
        "WaveletVariance.plot": "allanjax.report.spectrum_figure.plot_wavelet_variance",
    }
)
