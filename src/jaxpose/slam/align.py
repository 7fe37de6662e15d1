"""Second-order alignment of one camera pose to the map, by forward-mode Jacobians of the renderer."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxpose import se3
from jaxpose.render import Query
from jaxpose.slam.objective import Residuals, TrackConfig, image_loss, image_residuals
from jaxpose.slam.observe import Pixels

_SETTLED = 2e-4  # [m, rad] a step this small ends the alignment
_INDEPENDENT = 100.0  # pixels
_LONGEST = 0.1  # [m, rad] no step is longer


class Alignment(NamedTuple):
    """A pose, how well it explains the image, and the information the image holds about it."""

    T_world_cam: Float[Array, "4 4"]
    information: Float[Array, "6 6"]  # Gauss-Newton's matrix over right increments
    loss: Float[Array, ""]
    residuals: Residuals
    iterations: Int[Array, ""]


def starts(T_ref_body: Float[Array, "4 4"], sigma: Float[Array, "2"]) -> Float[Array, "k 4 4"]:
    """Motions to try first: the predicted one, and those `sigma` [m, rad] away along each axis."""
    axes = jnp.concatenate([jnp.eye(6), -jnp.eye(6)]) * jnp.repeat(sigma, 3)[None]
    return jnp.concatenate([T_ref_body[None], se3.compose(T_ref_body, se3.exp(axes))])


def best_start(
    query: Query,
    T_world_cam: Float[Array, "k 4 4"],
    pixels: Pixels,
    far: Float[Array, ""],
    config: TrackConfig,
    *,
    count: int = 150,
) -> Float[Array, "4 4"]:
    """The candidate pose that explains the first `count` pixels best; unexplained ones count as bad."""
    few = jax.tree.map(lambda x: x[:count], pixels)

    def score(T):
        found = image_residuals(query, T, few, far, config)
        worst = 20.0
        return jnp.mean(jnp.where(found.inlier > 0, jnp.minimum(jnp.abs(found.depth), worst), worst))

    return T_world_cam[jnp.argmin(jax.lax.map(score, T_world_cam))]


def align(
    query: Query,
    T_world_cam: Float[Array, "4 4"],
    T_world_predicted: Float[Array, "4 4"],
    sigma: Float[Array, "2"],
    pixels: Pixels,
    far: Float[Array, ""],
    config: TrackConfig,
) -> Alignment:
    """The pose that minimises the L1 image loss near a start, by reweighted Gauss-Newton steps.

    Six forward passes along the directions of the tangent space give the Jacobian. A step that makes the loss
    worse is taken back and tried again with ten times the damping. The predicted pose is a measurement too,
    with `sigma` [m, rad]; against it the image counts as `_INDEPENDENT` pixels, since errors of a map go
    together.
    """
    prior = jnp.repeat(sigma, 3) ** -2

    def linearised(T):
        at = lambda xi: _vectors(image_residuals(query, se3.compose(T, se3.exp(xi)), pixels, far, config))
        residuals, slope, aux = jax.linearize(at, jnp.zeros(6), has_aux=True)
        return residuals, jax.vmap(slope)(jnp.eye(6)), aux

    def equations(T):
        (depth, colour), (d_depth, d_colour), found = linearised(T)
        # L1 by reweighting; residuals within one sigma count by their square.
        w_depth = found.inlier / jnp.maximum(jnp.abs(depth), 1)
        w_colour = config.colour_weight / 3 * found.inlier[:, None] / jnp.maximum(jnp.abs(colour), 1)
        information = jnp.einsum("in,jn,n->ij", d_depth, d_depth, w_depth, precision="highest")
        information += jnp.einsum("inc,jnc,nc->ij", d_colour, d_colour, w_colour, precision="highest")
        slope = jnp.einsum("in,n,n->i", d_depth, depth, w_depth, precision="highest")
        slope += jnp.einsum("inc,nc,nc->i", d_colour, colour, w_colour, precision="highest")
        away = se3.log(se3.compose(se3.inverse(T_world_predicted), T))
        share = jnp.sum(found.inlier) / _INDEPENDENT
        information += share * jnp.diag(prior)
        slope += share * prior * away
        loss = image_loss(found, config)
        return information, slope, loss + jnp.sum(prior * away**2) / (2 * _INDEPENDENT), loss, found

    def improve(carry):
        best, lowest, (T, last_slope), damping, _, i = carry
        information, slope, total, loss, found = equations(T)
        better = total < lowest
        lowest = jnp.where(better, total, lowest)
        best = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), Alignment(T, information, loss, found, i), best
        )
        slope = jnp.where(better, slope, last_slope)
        damping = jnp.clip(jnp.where(better, damping / 10, damping * 10), 1e-4, 1e4)
        scaled = (
            best.information + (damping + 1e-6) * jnp.diag(jnp.diag(best.information)) + 1e-6 * jnp.eye(6)
        )
        step = -jnp.linalg.solve(scaled, slope)
        length = jnp.linalg.norm(step)
        step = step * jnp.minimum(1, _LONGEST / jnp.maximum(length, 1e-12))
        return best, lowest, (se3.compose(best.T_world_cam, se3.exp(step)), slope), damping, length, i + 1

    def unsettled(carry):
        *_, length, i = carry
        return (i < config.iterations) & (length > _SETTLED)

    count = pixels.depth.shape[0]
    nothing = Residuals(
        jnp.zeros(count), jnp.zeros((count, 3)), jnp.zeros(count), jnp.zeros(()), jnp.zeros(())
    )
    start = Alignment(T_world_cam, jnp.zeros((6, 6)), jnp.float32(jnp.inf), nothing, jnp.int32(0))
    carry = (start, jnp.inf, (T_world_cam, jnp.zeros(6)), jnp.float32(1e-2), jnp.inf, jnp.int32(0))
    best, *_, i = jax.lax.while_loop(unsettled, improve, carry)
    return best._replace(iterations=i)


def pose_sigma(found: Alignment) -> Float[Array, "2"]:
    """Standard deviation [m, rad] of an aligned pose along its worst axis."""
    share = jnp.maximum(jnp.sum(found.residuals.inlier), 1) / _INDEPENDENT
    covariance = jnp.linalg.inv(found.information / share + 1e-6 * jnp.eye(6))
    worst = lambda block: jnp.sqrt(jnp.linalg.eigvalsh(block)[-1])
    return jnp.stack([worst(covariance[:3, :3]), worst(covariance[3:, 3:])])


def _vectors(residuals: Residuals):
    return (residuals.depth, residuals.colour), residuals
