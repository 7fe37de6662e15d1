"""Joint training of a scene and a pose field."""
