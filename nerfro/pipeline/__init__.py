"""From photographs to a trained scene, a report and a page: the stages of `nerfro.reconstruct`."""
