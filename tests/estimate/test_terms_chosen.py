"""Sets of terms by evidence: integrals over the documented prior, the rules, and what follows from them."""

import bench
import golden_records as golden
import numpy as np
import pytest
from dense_fits import Spectrum, drawn, recording
from scipy.special import logsumexp

import allanjax as aj

RATE, SHORT = 10.0, 256
WHITE, WALK = aj.AngleRandomWalk(0.1), aj.RateRandomWalk(0.05)
NAMES = {"N": "angle_random_walk", "B": "bias_instability", "K": "rate_random_walk", "R": "drift_ramp"}
FOUR_DECADES = np.log1p(1e4)


class Integrals:
    """ln ∫ likelihood · prior over amplitudes, on grids uniform in ln(1 + c/scale)."""

    # The scale is where a term's power is one standard deviation: scale⁻⁴ = Σ ½ (s_j/S_j)², S at the maximum.
    def __init__(self, x):
        self.dense = Spectrum(x, RATE, np.arange(1, SHORT + 1))
        self.c, both = self.dense.c, WHITE + WALK
        self.white = self.dense.squares(aj.AngleRandomWalk(1.0))
        self.most_likely = self.dense.squares(self.dense.maximum(both, list(both.values)))
        self.size = np.sqrt(np.mean(self.c**2 / self.white))

    def likelihood(self, mean):
        return -0.5 * np.sum(np.log(mean) + self.c**2 / mean, axis=-1)

    def points(self, scale, low, high, steps):
        """Amplitudes uniform in ln(1 + c/scale), and ln of the prior probability of a step."""
        edges = np.log1p(np.array([low, high]) / scale)
        y = edges[0] + (np.arange(steps) + 0.5) / steps * np.diff(edges)
        return scale * np.expm1(y), np.log(np.diff(edges)[0] / steps / FOUR_DECADES)

    def random(self, squares, low, high, steps=300):
        """The same of a random term with these expected squares for unit amplitude."""
        return self.points(np.sum(0.5 * (squares / self.most_likely) ** 2) ** -0.25, low, high, steps)

    def alone(self):
        """White noise only."""
        a, step = self.random(self.white, 0.3 * self.size, 2.0 * self.size)
        return logsumexp(self.likelihood(a[:, None] ** 2 * self.white)) + step

    def beside(self, term):
        """White noise and a random term, at most as large as the record may have it."""
        other = self.dense.squares(term)
        a, of_white = self.random(self.white, 0.02 * self.size, 2.0 * self.size, 200)
        b, of_other = self.random(other, 0.0, 4.0 * np.sqrt(np.max(self.c**2 / other)), 200)
        means = a[:, None, None] ** 2 * self.white + b[:, None] ** 2 * other
        return logsumexp(self.likelihood(means)) + of_white + of_other

    def with_ramp(self):
        """White noise and a ramp of either sign, whose prior follows the noise that it leaves."""
        ramp = Spectrum(np.arange(SHORT) / RATE, RATE, np.arange(1, SHORT + 1)).c
        left = self.c - ramp * (ramp @ self.c) / (ramp @ ramp)
        size = np.sqrt(np.mean(left**2 / self.white))
        a, of_white = self.random(self.white, 0.5 * size, 1.6 * size)
        scale = size * np.sqrt(self.white.mean() / np.sum(ramp**2))
        R, of_ramp = self.points(scale, 0.0, 200.0 * scale, 2000)
        mean = a[:, None] ** 2 * self.white
        p, u = np.sum(ramp * self.c / mean, axis=1), np.sum(ramp**2 / mean, axis=1)
        signs = np.logaddexp(np.outer(p, R), -np.outer(p, R)) - np.log(2.0) - 0.5 * np.outer(u, R**2)
        return logsumexp(self.likelihood(mean)[:, None] + signs) + of_white + of_ramp


@pytest.fixture(scope="module")
def ranked():
    """White noise; with a walk; with a ramp; with a walk hardly there: records, and their rankings."""
    plain, walking = drawn(WHITE, SHORT, RATE, 20, 3), drawn(WHITE + WALK, SHORT, RATE, 21)
    ramp = 0.05 * np.arange(SHORT)[:, None] / RATE
    records = np.hstack([plain[:, :1], walking, plain[:, 1:2] + ramp, plain[:, 2:]])
    return records, aj.select_terms(recording(records, RATE), "N + K + R")


def test_evidence_is_the_integral_over_the_prior(ranked):
    """To 0.8 nats: Laplace's approximation is off by tenths where an amplitude is known to a third only."""
    # A ramp is integrated exactly: to 0.02 nats, the steps of the sum here.
    records, selection = ranked
    for axis, x in zip(selection.results, records.T, strict=True):
        assert axis.discrepancy == 0.0
        found, ours = {s.terms: s.log_evidence for s in axis.ranking}, Integrals(x)
        assert len(found) == 6
        beside = [found[(NAMES["N"], NAMES[t])] - found[(NAMES["N"],)] for t in "KR"]
        assert beside[0] == pytest.approx(ours.beside(aj.RateRandomWalk(1.0)) - ours.alone(), abs=0.8)
        assert beside[1] == pytest.approx(ours.with_ramp() - ours.alone(), abs=0.02)


def test_a_grid_of_times_is_one_set():
    """White noise: the evidence of a Markov process besides is the mean over 16 times, by quadrature."""
    # To 0.8 nats, as above; the sum would be ln 16 = 2.8 nats more.
    x = drawn(WHITE, SHORT, RATE, 24)[:, 0]
    selection, ours = aj.select_terms(recording(x, RATE), "N + markov"), Integrals(x)
    found = {s.terms: s.log_evidence for s in selection["gyro_0"].ranking}
    times = np.geomspace(4.0 / RATE, SHORT / RATE / 4.0, 16).tolist()
    expected = logsumexp([ours.beside(aj.Markov(1.0, T)) for T in times]) - np.log(16.0) - ours.alone()
    assert found[(NAMES["N"], "markov")] - found[(NAMES["N"],)] == pytest.approx(expected, abs=0.8)


def named(symbols):
    return tuple(NAMES[symbol] for symbol in symbols)


def by_hand(**odds):
    """A ranking of sets of terms from their odds against the best."""
    sets, total = [], sum(odds.values())
    for terms, w in sorted(odds.items(), key=lambda item: -item[1]):
        sets.append(aj.TermSet(named(terms), len(terms), float(np.log(w)), w / total))
    return aj.AxisSelection(aj.Axis("gyro_x", "gyro", "rad/s"), tuple(sets), 0.0)


def test_chosen_is_the_simplest_that_is_not_five_times_less_probable():
    assert by_hand(NK=1.0, N=0.21).chosen.terms == named("N")
    assert by_hand(NK=1.0, N=0.19).chosen.terms == named("NK")
    # Of equally many parameters, the more probable.
    assert by_hand(NBK=1.0, NK=0.4, NB=0.5).chosen.terms == named("NB")
    assert by_hand(NK=1.0, NBK=0.9).chosen.terms == named("NK")


def test_indistinguishable_are_those_with_odds_shorter_than_twenty():
    axis = by_hand(NK=1.0, NB=0.051, NBK=0.049)
    assert [s.terms for s in axis.indistinguishable] == [named("NK"), named("NB")]
    assert axis.best is axis.ranking[0]
    expected = dict(zip(named("NKB"), [1.0, 1.049 / 1.1, 0.1 / 1.1], strict=True))
    assert axis.inclusion == pytest.approx(expected, rel=1e-12)


def test_ambiguities_name_what_is_swapped_or_doubtful_with_its_odds():
    best = "on gyro_x (probabilities of the best sets:"
    for odds, told in (
        (
            {"NK": 1.0, "NB": 0.5},
            [f"undecided: rate random walk or bias instability {best} 67 % and 33 %)"],
        ),
        ({"N": 1.0, "NK": 0.5}, [f"undecided: rate random walk {best} 67 % without it, 33 % with it)"]),
        ({"NK": 1.0, "N": 0.15}, [f"undecided: rate random walk {best} 13 % without it, 87 % with it)"]),
        # Improbable, and no ambiguity worth a word.
        ({"N": 1.0, "NK": 0.06}, []),
        ({"N": 1.0, "NK": 0.01}, []),
    ):
        assert list(aj.TermSelection("", (by_hand(**odds),)).ambiguities()) == told


def test_a_chosen_term_is_doubtful_where_sets_without_it_have_a_share():
    for odds, doubtful in (
        # Of 1.9 the sets with flicker have 1.1, so 58 %, those with a walk 47 %.
        ({"NB": 1.0, "NK": 0.8, "NBK": 0.1}, {"B": "K"}),
        # A ramp is in a probable set that does as well without it, and stands in for nothing.
        ({"NB": 1.0, "NK": 0.8, "NKR": 0.3}, {"B": "K"}),
        # Where the alternative is nothing at all, nothing stands in its place.
        ({"NK": 1.0, "N": 0.19}, {"K": ""}),
        ({"NK": 1.0, "N": 0.01, "NBK": 0.1}, {}),
        # From 95 % on a term is certain.
        ({"NK": 1.0, "N": 0.052}, {}),
        ({"NK": 1.0, "N": 0.054}, {"K": ""}),
    ):
        assert by_hand(**odds).doubtful() == {NAMES[t]: named(rivals) for t, rivals in doubtful.items()}


def test_the_true_set_is_chosen_and_probabilities_follow_the_evidence():
    selection, truth = bench.selection("small"), bench.truth("small").truth
    for axis in selection.values():
        assert set(axis.chosen.terms) == set(truth[axis.axis.name])
        # All subsets of five terms and a Markov process but none, the ramp alone, and both of these.
        assert len(axis.ranking) == 62
        evidence = np.array([s.log_evidence for s in axis.ranking])
        assert (np.diff(evidence) <= 0.0).all()
        p = [s.probability for s in axis.ranking]
        np.testing.assert_allclose(p, np.exp(evidence - logsumexp(evidence)), rtol=1e-9)
        assert all(s.parameters == len(s.terms) + ("markov" in s.terms) for s in axis.ranking)
    table = selection.to_dataframe()
    assert (len(table), set(table["log_evidence"][table["rank"] == 1])) == (62 * len(selection), {0.0})


def test_units_and_a_bias_do_not_matter(ranked):
    records, selection = ranked
    again = aj.select_terms(recording(1e-7 * records + 3e-7, RATE), "N + K + R", axes=["gyro_1", "gyro_0"])
    assert again.axes == ("gyro_1", "gyro_0")
    for one, other in ((selection[axis], again[axis]) for axis in again):
        found = {s.terms: s.probability for s in other.ranking}
        for s in one.ranking:
            assert found[s.terms] == pytest.approx(s.probability, rel=1e-4, abs=1e-9)


def test_a_model_that_no_set_of_terms_follows_has_weaker_odds():
    """White noise under a line: the best set is off, and all evidences are brought nearer."""
    x = drawn(WHITE + WALK, SHORT, RATE, 21)[:, 0]
    line = 0.8 * np.sin(2.0 * np.pi * 1.0 * np.arange(SHORT) / RATE)
    good, bad = (aj.select_terms(recording(z, RATE), "N + K + R")["gyro_0"] for z in (x, x + line))
    assert good.discrepancy == 0.0 < 0.1 < bad.discrepancy
    spread = [s.ranking[0].log_evidence - s.ranking[-1].log_evidence for s in (good, bad)]
    assert spread[1] < 0.5 * spread[0]
    # There is no other set than that of a single term with a free time.
    (only,) = aj.select_terms(recording(x + line, RATE), "markov")["gyro_0"].ranking
    assert (only.terms, only.probability, only.log_evidence) == (("markov",), 1.0, 0.0)


def test_two_markov_processes_are_told_from_one_where_both_are_strong():
    """Correlation times of 0.2 and 20 s in 655 s; the candidates must have two."""
    records = map(bench.recording, ("two_markovs", "markov_slow"))
    both, alone = (aj.select_terms(x, "N + B + markov + markov").results[0] for x in records)
    assert {"markov_1", "markov_2"} <= set(both.best.terms)
    assert both.inclusion["markov_2"] > 0.5 > alone.inclusion["markov_2"]
    assert alone.chosen.terms == ("angle_random_walk", "markov_1")


def test_a_fit_without_a_model_uses_the_chosen_sets():
    fit = bench.fit("small")
    assert fit.chosen
    for result, axis in zip(fit.results, fit.selection.results, strict=True):
        assert set(result.model.term_labels) <= set(axis.chosen.terms)
        for c in (c for c in result.coefficients.values() if c.term not in axis.chosen.terms):
            assert not c.detected
            assert not c.is_amplitude or (c.value == 0.0 < c.upper_limit < np.inf)


def test_a_slow_term_that_may_be_another_is_not_called_detected():
    """Of flicker that is just seen: a term is detected where the sets with it have 95 %, and no other."""
    # Twelve records of 164 s, in which white noise and flicker of these sizes meet at 16 s.
    rng = np.random.default_rng(500)
    x = np.stack([golden.sensor(rng, 2048, RATE, **golden.crossing(0.1, B=16.0)) for _ in range(12)], axis=1)
    found, told = aj.fit(recording(x, RATE), as_is=True, vibrating=True), 0
    for result in found.results:
        ranking = found.selection[result.axis.name]
        doubtful = ranking.doubtful()
        for c in result.coefficients.values():
            if c.is_amplitude and c.term in ranking.chosen.terms:
                seen = c.interval[0] > 0.0
                assert c.detected == (seen and c.term not in doubtful)
                assert c.rivals == (doubtful.get(c.term, ()) if seen else ())
                told += bool(c.rivals)
    assert told > 0
