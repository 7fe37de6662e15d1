"""Pictures: one style, one file an application."""
