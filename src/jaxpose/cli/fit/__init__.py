"""`jaxpose fit`."""
