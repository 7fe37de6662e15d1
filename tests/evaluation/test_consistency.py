"""NEES and coverage: of errors drawn from their covariances, and of such as are larger."""

import numpy as np
import pytest

from jaxpose.errors import DataError
from jaxpose.evaluation.consistency import aligned_error, consistency, relative_error
from jaxpose.geometry import rigid


def drawn(count, seed=0):
    """Poses on a path, estimates with errors on their right, and the covariances of these."""
    rng = np.random.default_rng(seed)
    truth = rigid.exp(np.cumsum(0.1 * rng.normal(size=(count, 6)), axis=0))
    root = 0.01 * np.tril(rng.normal(size=(count, 6, 6))) + 0.01 * np.eye(6)
    error = (root @ rng.normal(size=(count, 6, 1)))[..., 0]
    return truth, truth @ rigid.exp(-error), root @ np.swapaxes(root, 1, 2), error


def test_errors_that_are_as_large_as_stated():
    _, _, P, error = drawn(4000)
    found = consistency(error, P, independent=4000)
    assert found.band[0] < found.nees < found.band[1] and found.count == 4000
    assert found.inside_50 == pytest.approx(0.5, abs=0.03)
    assert found.inside_90 == pytest.approx(0.9, abs=0.02)


def test_errors_of_twice_the_size_are_seen():
    _, _, P, error = drawn(4000)
    found = consistency(2 * error, P, independent=100)
    assert found.nees == pytest.approx(24, rel=0.05) and found.nees > found.band[1]
    assert found.inside_90 < 0.3


def test_an_alignment_takes_six_degrees_of_freedom():
    """Poses moved as a whole: what is left has 6 n - 6 degrees, in the mean over many draws."""
    moved = rigid.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.02]))
    sums = []
    for seed in range(40):
        truth, estimate, P, _ = drawn(10, seed)
        error = aligned_error(moved @ estimate, truth, P)
        sums.append(10 * consistency(error, P, independent=10).nees)
    assert np.mean(sums) == pytest.approx(54, rel=0.1)


def test_relative_errors_do_not_know_the_world():
    truth, estimate, _, _ = drawn(10)
    moved = rigid.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))
    here = relative_error((estimate[:-1], estimate[1:]), (truth[:-1], truth[1:]))
    there = relative_error((moved @ estimate[:-1], moved @ estimate[1:]), (truth[:-1], truth[1:]))
    np.testing.assert_allclose(here, there, atol=1e-9)
    again = rigid.inverse(estimate[:-1]) @ estimate[1:] @ rigid.exp(here)
    np.testing.assert_allclose(again, rigid.inverse(truth[:-1]) @ truth[1:], atol=1e-9)


def test_what_cannot_be_measured_is_refused():
    with pytest.raises(DataError, match="expected at least one error"):
        consistency(np.zeros((0, 6)), np.zeros((0, 6, 6)), independent=1)
    with pytest.raises(DataError, match="positive definite"):
        consistency(np.zeros((2, 6)), np.zeros((2, 6, 6)), independent=1)
