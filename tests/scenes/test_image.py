"""The neural image: BARF's network, its draw, its window."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose.fields import set_progress
from jaxpose.scenes._image import ImageConfig, image

SMALL = ImageConfig(octaves=3, layers=3, width=16)


def colours(config, params, xy):
    return jax.jit(jax.vmap(partial(image(config).query, params)))(xy)


def by_hand(params, xy, weights):
    """The network in numpy: coordinates and, one coordinate after the other, sines and cosines."""
    columns = [xy]
    for coordinate in xy.T:
        for wave in (np.sin, np.cos):
            columns += [w * wave(2**k * np.pi * coordinate)[:, None] for k, w in enumerate(weights)]
    hidden = np.concatenate(columns, axis=1)
    for number in range(len(params["mlp"])):
        layer = params["mlp"][f"layer_{number}"]
        hidden = hidden @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        if number < len(params["mlp"]) - 1:
            hidden = np.maximum(hidden, 0)
    return 1 / (1 + np.exp(-hidden))


@pytest.mark.parametrize(
    ("progress", "weights"),
    [(0.0, (0, 0, 0)), (0.2, (1, 0.5, 0)), (0.4, (1, 1, 1)), (1.0, (1, 1, 1))],
)
def test_it_is_the_network_written_out_at_every_stage_of_the_window(progress, weights, dtype):
    params = jax.tree.map(lambda x: x.astype(dtype), image(SMALL).init(jax.random.key(1)))
    xy = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    found = colours(SMALL, set_progress(params, jnp.asarray(progress, dtype)), jnp.asarray(xy, dtype))
    assert found.dtype == dtype
    tolerance = 2e-5 if dtype == jnp.float32 else 1e-12
    assert_allclose(found, by_hand(params, xy, weights), atol=tolerance)


def test_without_a_window_all_bands_are_open():
    config = ImageConfig(octaves=3, layers=3, width=16, window=None)
    params = image(config).init(jax.random.key(1))
    xy = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    assert set(params) == {"mlp"}
    assert_allclose(colours(config, params, jnp.asarray(xy)), by_hand(params, xy, (1, 1, 1)), atol=2e-5)


def test_the_default_is_barfs_network_drawn_as_barf_draws_it():
    params = image().init(jax.random.key(0))
    assert sum(leaf.size for leaf in jax.tree.leaves(params["mlp"])) == 35 * 256 + 3 * 257 * 256 + 257 * 3
    for number, (inputs, wider) in enumerate([(34, np.sqrt(17)), (256, 1), (256, 1), (256, 1), (256, 1)]):
        bound = wider / np.sqrt(inputs)
        for values in params["mlp"][f"layer_{number}"].values():
            assert np.abs(values).max() <= bound
        kernel = np.asarray(params["mlp"][f"layer_{number}"]["kernel"])
        assert np.abs(kernel).max() > 0.98 * bound
        assert kernel.std() == pytest.approx(bound / np.sqrt(3), rel=0.05)
        assert abs(kernel.mean()) < 0.1 * bound
    first, second = (np.asarray(params["mlp"][f"layer_{k}"]["kernel"]) for k in (1, 2))
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02  # no draw is used twice


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(octaves=-1), "octaves >= 0"),
        (dict(layers=0), "layers >= 1"),
        (dict(width=0), "width >= 1"),
        (dict(window=(0.4, 0.4)), "start < end"),
    ],
)
def test_settings_that_mean_nothing_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        image(ImageConfig(**change))
