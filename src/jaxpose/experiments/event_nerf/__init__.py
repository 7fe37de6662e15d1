"""NeRF from events: `python -m jaxpose.experiments.event_nerf`."""
