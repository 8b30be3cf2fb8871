"""A set-up as SCENE.toml describes it: lamps, camera, body, paint, and where lights reflect; nothing is rendered."""
