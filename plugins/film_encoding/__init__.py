"""Films of rendered frames, MP4 and GIF: `film=` of `python -m nerfro.render`."""
