"""Other libraries on the environment, each with its own code; they run apart (pytest -m clients)."""
