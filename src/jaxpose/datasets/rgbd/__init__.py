"""RGB-D recordings."""
