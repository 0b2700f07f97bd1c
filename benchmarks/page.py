"""A page of measurements in docs/, made section by section; the benchmarks that write one share
this.
"""

import argparse
import re
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parent.parent
ASSETS = ROOT.parent / "shared" / "assets"


def write_page(description, head, sections, name):
    """Run the sections that the command line names and write them into the page; the other ones
    stay as they are.

    Parameters
    ----------
    description : str
        For `--help`.
    head : str
        The page's beginning.
    sections : dict
        Functions (assets folder, pictures folder) that yield lines of Markdown, by their names.
    name : str
        Of the page in docs/; its pictures go to a folder of that name.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--assets", type=Path, default=ASSETS)
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / name)
    parser.add_argument("--only", default="", help=f"some of {', '.join(sections)}")
    arguments = parser.parse_args()
    chosen = [section for section in arguments.only.split(",") if section] or list(sections)
    if unknown := set(chosen) - set(sections):
        parser.error(f"--only {','.join(sorted(unknown))}: choose from {', '.join(sections)}")
    pictures = arguments.output.with_suffix("")
    pictures.mkdir(parents=True, exist_ok=True)
    texts = _existing(arguments.output)
    for section in chosen:
        started = time.perf_counter()
        texts[section] = "\n".join(sections[section](arguments.assets, pictures)).strip()
        print(
            f"{texts[section]}\n\n({section}: {time.perf_counter() - started:.0f} s)\n", flush=True
        )
        page = [head] + [f"<!-- {key} -->\n{texts[key]}" for key in sections if key in texts]
        arguments.output.write_text("\n\n".join(page) + "\n")


def saved(figure, pictures, name):
    """Save a figure; the Markdown line that shows it."""
    figure.tight_layout()
    figure.savefig(pictures / f"{name}.png", dpi=110)
    plt.close(figure)
    return f"\n![{name}]({pictures.name}/{name}.png)\n"


def _existing(path):
    """The sections of a page by their names."""
    if not path.exists():
        return {}
    parts = re.split(r"<!-- (\w+) -->\n", path.read_text())
    return dict(zip(parts[1::2], (part.strip() for part in parts[2::2])))
