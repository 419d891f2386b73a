"""The pictures of a posterior."""

import dataclasses
import types

import numpy as np
import pytest

from allanjax.base.errors import AllanjaxError
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import AngleRandomWalk, Markov
from allanjax.posterior.priors import LogUniform, ModifiedLogUniform
from allanjax.posterior.result import AxisPosterior, Posterior
from allanjax.report.posterior_figure import plot_corner, plot_posterior

pytestmark = pytest.mark.usefixtures("no_windows")

N, Q, TIME = 5e-5, 2e-4, 20.0
LABELS = ("angle_random_walk", "markov_amplitude", "markov_correlation_time")
MICRO_G = 9.80665e-6


@pytest.fixture(scope="module")
def posterior(small_fit):
    """Log-normal draws of N, q_c and T_c, without a sampler."""
    random = np.random.default_rng(0)
    draws = np.array([N, Q, TIME]) * np.exp(random.standard_normal((4000, 3)) * [0.01, 0.1, 0.2])
    template = AngleRandomWalk() + Markov()
    results = []
    for name in ("gyro_x", "accel_z"):
        axis = small_fit[name].axis
        marginals = {
            p.label: Estimate(
                source="posterior",
                label=p.label,
                term=p.term_label,
                parameter=p.parameter,
                axis=axis,
                value=float(np.median(x)),
                std=float(x.std()),
                interval=tuple(np.quantile(x, [0.025, 0.975]).tolist()),
                interval_68=tuple(np.quantile(x, [0.16, 0.84]).tolist()),
                upper_limit=None if p.parameter.kind == "time" else float(np.quantile(x, 0.95)),
                detected=True,
            )
            for p, x in zip(template.parameters, draws.T, strict=True)
        }
        results.append(
            AxisPosterior(
                axis=axis,
                labels=LABELS,
                draws=draws,
                chain=draws.reshape(125, 32, 3),
                log_probability=np.zeros((125, 32)),
                coefficients=marginals,
                priors={
                    "angle_random_walk": ModifiedLogUniform(1e-6, 1.0),
                    "markov_amplitude": ModifiedLogUniform(1e-4, 1.0),
                    "markov_correlation_time": LogUniform(1.0, 100.0),
                },
                converged=name == "gyro_x",
                tau=np.full(3, 2.0),
                r_hat=np.full(3, 1.001),
                acceptance=0.5,
                steps=150,
                rate=100.0,
                duration=200.0,
                _template=template,
            )
        )
    return Posterior(dataclasses.replace(small_fit, template=template), tuple(results))


def test_the_corner_has_a_panel_for_every_pair_and_units_at_its_edges(posterior, tmp_path):
    figure = plot_corner(posterior["gyro_x"], tmp_path / "corner.png")
    assert (tmp_path / "corner.png").stat().st_size > 10_000
    assert len(figure.axes) == 6
    wanted = [
        "angle random walk\nN [deg/√h]",
        "markov amplitude\nq_c [deg/h/√h]",
        "markov correlation\ntime\nT_c [s]",
    ]
    assert [panel.get_xlabel() for panel in figure.axes[3:]] == wanted
    assert [figure.axes[i].get_ylabel() for i in (1, 3)] == wanted[1:]
    assert all(not panel.get_xlabel() for panel in figure.axes[:3])
    accel = plot_corner(posterior["accel_z"])
    assert accel.axes[3].get_xlabel() == "velocity random walk\nN [m/s/√h]"
    assert any("NOT CONVERGED" in text.get_text() for text in accel.texts)


def test_the_diagonal_shows_density_median_interval_and_prior_in_display_units(posterior):
    axis = posterior["gyro_x"]
    time = plot_corner(axis).axes[5]
    draws = axis.draws[:, 2]
    marks = [line.get_xdata()[0] for line in time.get_lines() if line.get_label() != "prior"]
    np.testing.assert_allclose(sorted(marks), np.quantile(draws, [0.16, 0.5, 0.84]))
    (prior,) = [line for line in time.get_lines() if line.get_label() == "prior"]
    x, density = prior.get_data()
    np.testing.assert_allclose(density, 1.0 / (x * np.log(100.0)), rtol=1e-9)
    # Log-normal: the peak of the drawn histogram, within its bins' noise.
    steps = time.patches[0].get_data()
    assert np.sum(steps.values * np.diff(steps.edges)) == pytest.approx(1.0, abs=5e-3)
    walk = plot_corner(axis).axes[0]
    marks = sorted(line.get_xdata()[0] for line in walk.get_lines() if line.get_label() != "prior")
    assert marks[1] == pytest.approx(np.degrees(N) * 60.0, rel=1e-3)
    # Of an amplitude the prior is a density per deg/√h: 1/[(x + scale)·ln(1 + upper/scale)].
    (prior,) = [line for line in walk.get_lines() if line.get_label() == "prior"]
    x, density = prior.get_data()
    expected = 1.0 / ((x + np.degrees(1e-6) * 60.0) * np.log1p(1e6))
    np.testing.assert_allclose(density, expected, rtol=1e-9)
    assert "±" in walk.get_title()


def test_contours_hold_their_share_of_the_draws(posterior):
    axis = posterior["gyro_x"]
    panel = plot_corner(axis).axes[1]
    contours = panel.collections[-1]
    points = np.column_stack([np.degrees(axis.draws[:, 0]) * 60.0, np.degrees(axis.draws[:, 1]) * 60.0**3])
    for path, share in zip(contours.get_paths(), (0.95, 0.68), strict=True):
        # Smoothing widens them a little.
        assert path.contains_points(points).mean() == pytest.approx(share, abs=0.03)


def test_one_parameter_alone_has_one_panel(posterior):
    axis = posterior["gyro_x"]
    alone = dataclasses.replace(
        axis,
        labels=LABELS[:1],
        draws=axis.draws[:, :1],
        chain=axis.chain[..., :1],
        tau=axis.tau[:1],
        r_hat=axis.r_hat[:1],
    )
    figure = plot_corner(alone)
    assert len(figure.axes) == 1
    assert figure.axes[0].get_xlabel() == "angle random walk\nN [deg/√h]"


def test_bands_are_quantiles_of_the_draws_curves(posterior, tmp_path):
    figure = plot_posterior(posterior, path=tmp_path / "bands.png")
    assert (tmp_path / "bands.png").stat().st_size > 10_000
    deviation, density = figure.axes[2:4]
    assert deviation.get_title(loc="left") == "accel_z, NOT CONVERGED"
    assert deviation.get_xlabel() == "cluster time T [s]"
    assert deviation.get_ylabel() == "Allan deviation [µg]"
    assert density.get_xlabel() == "frequency [Hz]"
    assert density.get_ylabel() == "one-sided PSD [µg²/Hz]"
    axis = posterior["accel_z"]
    for panel, curves in ((deviation, "deviation"), (density, "density")):
        (median,) = [line for line in panel.get_lines() if line.get_label() == "median"]
        x, y = median.get_data()
        models = [m.sampled(100.0) for m in axis.models(60)]
        if curves == "deviation":
            exact = np.array([np.sqrt(np.asarray(m.allan_variance(x[::40]))) for m in models]) / MICRO_G
        else:
            exact = np.array([2.0 * np.asarray(m.sampled_psd(x[::40], 100.0)) for m in models]) / MICRO_G**2
        # Sixty draws against three hundred: three standard errors of a median.
        error = 3.0 * 1.25 * np.log(exact).std(axis=0) * np.sqrt(1 / 60 + 1 / 300)
        assert np.all(abs(np.log(y[::40] / np.median(exact, axis=0))) < error)
        band = {
            c.get_label(): c.get_paths()[0].get_extents() for c in panel.collections if "%" in c.get_label()
        }
        assert band["95 %"].y1 > band["68 %"].y1 > y.max()


def test_measured_points_are_drawn_where_they_are_given(posterior, small_fit):
    frequency = np.array([0.0, 0.1, 1.0, 10.0])
    axes = tuple(result.axis for result in small_fit.results)
    spectrum = types.SimpleNamespace(
        frequency=frequency, density=np.outer([0.0, 4.0, 2.0, 1.0], [1, 2, 3, 4]), axes=axes
    )
    figure = plot_posterior(posterior, small_fit, ["accel_z"], spectrum=spectrum)
    assert len(figure.axes) == 2
    (measured,) = [line for line in figure.axes[1].get_lines() if line.get_label() == "measured"]
    np.testing.assert_allclose(measured.get_xdata(), frequency[1:])
    np.testing.assert_allclose(measured.get_ydata(), 4.0 * np.array([4.0, 2.0, 1.0]) / MICRO_G**2)
    (points,) = [c for c in figure.axes[0].containers if c.get_label() == "measured"]
    np.testing.assert_allclose(points[0].get_ydata(), small_fit.curve.deviation[:, 3] / MICRO_G)


def test_methods_draw_the_same_and_unknown_axes_are_refused(posterior, small_fit):
    assert len(posterior.plot().axes) == 4
    assert len(posterior["gyro_x"].plot_corner().axes) == 6
    with pytest.raises(AllanjaxError, match="gyro_q"):
        posterior.plot(axes=["gyro_q"])
    with pytest.raises(AllanjaxError, match="at least one axis"):
        posterior.plot(axes=[])
    other = dataclasses.replace(small_fit.curve, axes=None)
    with pytest.raises(AllanjaxError, match="no axis 'gyro_x'"):
        posterior.plot(other)
