"""The code blocks of README run as they stand, and print what their comments say."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def printed():
    """What each call of print was given, and the names of the blocks."""
    values, names = [], {}
    names["print"] = lambda *args: values.append([np.asarray(x) for x in args])
    for block in BLOCKS:
        exec(compile(block, str(README), "exec"), names)
    return values, names


def test_a_fit_and_its_motion(printed):
    """A constant twist: the rate in the body is its own, the acceleration is the velocity's turning."""
    (small, omega, acceleration, _), names = printed
    assert all(small)
    np.testing.assert_allclose(omega[0], [0, 0, 0.4], atol=1e-4)
    angle = 0.4 * 0.73
    np.testing.assert_allclose(
        acceleration[0], 0.3 * 0.4 * np.array([-np.sin(angle), np.cos(angle), 0]), atol=2e-3
    )
    stated = [float(x) for x in re.search(r"acceleration_world\)  # \[(.*?)\]", BLOCKS[0])[1].split(",")]
    np.testing.assert_allclose(acceleration[0], stated, atol=2e-3)
    assert jnp.abs(names["gradient"]).max() > 0.1


def test_frames_one_by_one(printed):
    assert printed[0][3][0]


def test_readme_is_one_screenful_of_pictures_and_code():
    text = README.read_text()
    assert len(text.splitlines()) <= 160
    for path in re.findall(r"\]\(((?!http)[^)#]+)\)", text):
        assert (README.parent / path).exists(), path
