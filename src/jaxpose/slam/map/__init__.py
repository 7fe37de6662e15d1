"""The map: integrate, texture, mesh."""
