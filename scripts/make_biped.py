"""Write the URDF of the biped in `configs/` from its description: `python scripts/make_biped.py`."""

from pathlib import Path

from paper.biped import biped_urdf

if __name__ == "__main__":
    (Path(__file__).resolve().parents[1] / "configs" / "biped.urdf").write_bytes(biped_urdf())
