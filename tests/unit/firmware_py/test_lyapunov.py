"""The Lyapunov equation (21) and the ultimate bounds (30)."""

from __future__ import annotations

import numpy as np
import pytest

from jointctl.firmware_py.law import eigenvalues, solve_lyapunov_p, ultimate_bounds

KP, KV = 784.0, 56.0


@pytest.mark.parametrize(
    ("q", "expected"), [(2500.0, (17611.607, 1.594388, 22.349900)), (1800.0, (12680.357, 1.147959, 16.091928))]
)
def test_both_matrices_of_the_paper(q: float, expected: tuple[float, ...]) -> None:
    p11, p12, p22 = solve_lyapunov_p(KP, KV, q, q)
    assert p11 == pytest.approx(expected[0], abs=5e-4)
    assert (p12, p22) == pytest.approx(expected[1:], abs=5e-7)


@pytest.mark.parametrize(
    ("kp", "kv", "q1", "q2"), [(784.0, 56.0, 2500.0, 2500.0), (2500.0, 130.0, 2.756e6, 4630.0), (1.0, 0.1, 3.0, 7.0)]
)
def test_the_equation_holds(kp: float, kv: float, q1: float, q2: float) -> None:
    p11, p12, p22 = solve_lyapunov_p(kp, kv, q1, q2)
    p = np.array([[p11, p12], [p12, p22]])
    a = np.array([[0.0, 1.0], [-kp, -kv]])
    np.testing.assert_allclose(p @ a + a.T @ p, -np.diag([q1, q2]), atol=1e-9 * max(q1, q2, p11 * kv))
    np.testing.assert_allclose(eigenvalues(p11, p12, p22), np.linalg.eigvalsh(p), rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(p) > 0.0)


@pytest.mark.parametrize("q", [1800.0, 2500.0])
def test_ultimate_bounds(q: float) -> None:
    """Both scale with eps0 and neither depends on q for Q = q I."""
    loose, tight = ultimate_bounds(*solve_lyapunov_p(KP, KV, q, q), q, q, 2.1, 1.0)
    assert loose == pytest.approx(6.71, abs=5e-3)
    assert tight == pytest.approx(0.0085, abs=5e-5)
    twice = ultimate_bounds(*solve_lyapunov_p(KP, KV, q, q), q, q, 2.1, 2.0)
    assert twice == pytest.approx((2.0 * loose, 2.0 * tight))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((0.0, 56.0, 1.0, 1.0), r"kp \(=0\)"),
        ((784.0, -1.0, 1.0, 1.0), r"kv \(=-1\)"),
        ((float("nan"), 56.0, 1.0, 1.0), r"kp \(=nan\)"),
        ((784.0, 56.0, 0.0, 1.0), r"Q \(=diag\(0, 1\)\)"),
        ((784.0, 56.0, 1.0, -1.0), r"Q \(=diag\(1, -1\)\)"),
    ],
)
def test_what_has_no_positive_solution_is_refused(arguments: tuple[float, ...], named: str) -> None:
    with pytest.raises(ValueError, match=named) as caught:
        solve_lyapunov_p(*arguments)
    assert "\n" not in str(caught.value)
