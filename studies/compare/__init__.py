"""Engines side by side on one scene: tables and a picture, by ``python -m studies compare``."""
