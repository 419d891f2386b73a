"""Presentation of results to people: figures, tables, stories and files.

Importing this room gives results their methods that draw, tell and export (see `base.late`).
"""

from allanjax.base.late import present

present(
    {
        "AllanDeviation.plot": "allanjax.presentation.allan_figure.plot_allan",
        "Autocorrelation.plot": "allanjax.presentation.spectrum_figure.plot_autocorrelation",
        "AxisPosterior.plot_corner": "allanjax.presentation.posterior_figure.plot_corner",
        "BiasTracks.plot": "allanjax.presentation.navigation_figure.plot_bias_tracks",
        "Calibration.plot": "allanjax.presentation.navigation_figure.plot_calibration",
        "Comparison.plot": "allanjax.presentation.allan_figure.plot_comparison",
        "Critique.__str__": "allanjax.presentation.critique_story.story",
        "Critique.details": "allanjax.presentation.critique_story.details",
        "Critique.plot": "allanjax.presentation.critique_figure.plot_critique",
        "Critique.to_dict": "allanjax.presentation.critique_json.to_dict",
        "DynamicAllan.plot": "allanjax.presentation.allan_figure.plot_dynamic",
        "Finding.__repr__": "allanjax.presentation.critique_story.finding_repr",
        "Finding.__str__": "allanjax.presentation.critique_story.finding_text",
        "Fit.plot": "allanjax.presentation.allan_figure.plot_allan",
        "Fit.to_dict": "allanjax.estimate.as_json.to_dict",
        "FleetResult.plot": "allanjax.presentation.fleet_figure.plot_fleet",
        "JointFit.plot": "allanjax.presentation.fleet_figure.plot_joint",
        "Navigation.plot": "allanjax.presentation.navigation_figure.plot_navigation",
        "Posterior.plot": "allanjax.presentation.posterior_figure.plot_posterior",
        "PowerSpectrum.plot": "allanjax.presentation.spectrum_figure.plot_spectrum",
        "SampleRates.plot": "allanjax.presentation.allan_figure.plot_sample_rates",
        "SpecCheck.to_junit": "allanjax.presentation.files.to_junit",
        "FleetResult.to_junit": "allanjax.presentation.files.fleet_to_junit",
        "StateSpace.to_c_header": "allanjax.presentation.files.to_c_header",
        "StateSpace.to_matlab": "allanjax.presentation.files.to_matlab",
        "StateSpace.to_numpy": "allanjax.presentation.files.to_numpy",
        "WaveletDecomposition.plot": "allanjax.presentation.spectrum_figure.plot_decomposition",
        "WaveletVariance.plot": "allanjax.presentation.spectrum_figure.plot_wavelet_variance",
    }
)
