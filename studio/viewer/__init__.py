"""The studio's page: a viser scene with panels round it."""
