"""`jaxpose check`."""
