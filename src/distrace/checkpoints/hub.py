"""Models of the Hugging Face Hub: folders of `config.json`, `model.safetensors` and a model card, `README.md`.

`Model` does not derive from `ModelHubMixin`: every `import distrace` would then need that optional library.
"""

import json
import re
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

from distrace.checkpoints.model import Model, bundled_models, load_model, save_model
from distrace.checkpoints.specs_file import CONFIG, SPECS
from distrace.errors import error_context
from distrace.files import save_text
from distrace.optional import require

WEIGHTS = "model.safetensors"
CARD = "README.md"
TRAINING = "## Training data"
NAMED = 12  # shapes that a card names


def from_pretrained(name: str | Path, download: bool, revision: str | None, cache: Path | None) -> Model:
    """Returns a bundled model, a folder's, or a repository's; see `Model.from_pretrained`."""
    if str(name) in bundled_models() or Path(name).exists() or not re.fullmatch(r"[\w.-]+/[\w.-]+", str(name)):
        return load_model(name)
    folder = _snapshot(str(name), download, revision, cache)
    for file in (CONFIG, WEIGHTS):
        if not (folder / file).is_file():
            raise ValueError(f"{name} holds no {file}: it is no model of distrace, or only a part of it was downloaded")
    return replace(load_model(folder), name=str(name).split("/")[1])


def save_pretrained(model: Model, folder: Path, licence: str, trained_on: str) -> None:
    """Writes a model and its card; see `Model.save_pretrained`."""
    if not re.fullmatch(r"[\w.+-]+", licence):
        raise ValueError(f"licence={licence!r} was given; give an identifier like mit or cc-by-4.0")
    if (folder / SPECS).exists():
        raise ValueError(f"{folder} holds a DeepSDF experiment, or a model that save_model wrote; give another folder")
    card = _card(model, licence, trained_on)  # first: it may read the folder that is about to be written
    save_model(folder, model)
    (folder / SPECS).replace(folder / CONFIG)
    save_text(folder / CARD, card)


def push_to_hub(model: Model, repository: str, licence: str, trained_on: str, private: bool) -> str:
    """Uploads a model and its card; see `Model.push_to_hub`."""
    require("an upload to the Hugging Face Hub", "huggingface_hub")
    from huggingface_hub import HfApi

    named = replace(model, name=repository.split("/")[-1])
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        save_pretrained(named, folder, licence, trained_on)
        with error_context(f"{repository} could not be uploaded to the Hugging Face Hub"):
            api = HfApi(library_name="distrace", library_version=version("distrace"))
            api.create_repo(repository, private=private, exist_ok=True)
            commit = api.upload_folder(repo_id=repository, folder_path=folder, commit_message=f"Upload {named.name}")
    return str(commit.commit_url)


def _snapshot(repository: str, download: bool, revision: str | None, cache: Path | None) -> Path:
    """Returns the folder of a repository's files in the cache."""
    require(f"{repository}, which is no folder here,", "huggingface_hub")
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        with error_context(f"{repository} could not be read from the Hugging Face Hub"):
            folder = snapshot_download(
                repository,
                revision=revision,
                cache_dir=cache,
                local_files_only=not download,
                allow_patterns=[CONFIG, WEIGHTS, CARD],
                library_name="distrace",
                library_version=version("distrace"),
            )
    except ValueError as error:
        if download or not isinstance(error.__cause__, LocalEntryNotFoundError):
            raise
        raise ValueError(
            f"{repository} is neither a folder nor a bundled model, and the Hugging Face Hub's cache has no such model;"
            " download=True fetches it"
        ) from error
    return Path(str(folder))


def _card(model: Model, licence: str, trained_on: str) -> str:
    """Returns a model card: what the model is, its facts, how to load it, and what it was trained on."""
    names = ", ".join(model.shapes[:NAMED]) + (" …" if len(model.shapes) > NAMED else "")
    specs = model.decoder.specs
    return f"""---
library_name: distrace
license: {licence}
tags: [signed-distance-function, deepsdf, 3d]
---
# {model.name}

A DeepSDF decoder: one network, and a code for each of its shapes, whose signed distances it computes at any point.
Shapes lie in the unit sphere. The Python package `distrace` renders, completes and meshes them.

| | |
|---|---|
| shapes | {len(model.shapes)}: {names} |
| network | {specs.size}, {_parameters(model):,} weights |
| codes | {specs.code_length} values each |
| precision | half |
| licence | {licence} |
| written by | distrace {version("distrace")} |

```python
import distrace as dt

model = dt.Model.from_pretrained("owner/{model.name}", download=True)  # or a folder with these files
buffers = dt.render(model.field(0), dt.Camera.orbit(30, 20, 4.97, height=256, width=256))
```

{TRAINING}

{trained_on or _training(model)}
"""


def _parameters(model: Model) -> int:
    """Returns the number of weights and biases, without weight norm."""
    layers = (getattr(model.decoder, f"lin{layer}") for layer in range(model.decoder.depth))
    return sum(layer.weight.numel() + layer.bias.numel() for layer in layers)


def _training(model: Model) -> str:
    """Returns what the model's own folder says of its training: its card or page, or else the command of `train`."""
    folder = model.folder
    if folder is not None and (folder / CARD).is_file():
        text = re.sub(r"\A---\n.*?\n---\n", "", (folder / CARD).read_text(encoding="utf-8"), flags=re.DOTALL)
        text = text.split(f"{TRAINING}\n", 1)[-1]
        return re.sub(r"^!\[.*\n", "", text, flags=re.MULTILINE).strip()  # pictures stay behind
    if folder is not None and (folder / "result.json").is_file():
        with error_context(f"{folder / 'result.json'} is no result of a command"):
            result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
            facts = ", ".join(f"{name} {result[name]}" for name in ("steps", "loss", "shapes") if name in result)
            return f"`{result['command']}`: {facts}, by distrace {result['version']}."
    return "Unknown."
