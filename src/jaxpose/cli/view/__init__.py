"""`jaxpose view`."""
