"""NeRF from noisy or unknown poses: `python -m jaxpose.experiments.noisy_nerf`."""
