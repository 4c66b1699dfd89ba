"""Add trained scene encoders to the pretrained ones: network, JSON, and a figure.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/keep_encoders.py runs/RUN ...    # of vae.py, vqvae.py, pointnet2.py, field.py

Of each finished run, `encoder.pt` becomes `envs/perception/pretrained/<script>.pt`, which
`--encoder <script>` finds, and its decoder, if there is one, `<script>.decoder.pt`. With
`--float16` they are in half precision; then policies that use the encoder have to be evaluated
again. The JSON beside it has data, updates, scores on validation scenes and flags;
`docs/figures/encoder_<script>.png` is TensorBoard's image of a validation scene at the update of
the encoder.
"""

import argparse
import datetime
import io
import json
import shutil
import sys
from pathlib import Path

from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from roboarm_nmp.datasets.format import attribute
from roboarm_nmp.datasets.observations import open_shard
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.envs.perception.encoders import DECODER, PRETRAINED
from roboarm_nmp.networks.exported_networks import to_float16
from roboarm_nmp.utils.files import write_atomically

sys.path.insert(0, str(Path(__file__).resolve().parent))
from paper_tables import FIGURES, commit

ENLARGED = 2  # each pixel of TensorBoard's image, in width and height
PATHS = ("runs_dir", "resume", "observations")  # flags that do not describe the encoder


def validation_image(run, step):
    """TensorBoard's image of a run at one evaluation, a PIL image."""
    events = EventAccumulator(str(run), size_guidance={"images": 0}).Reload()
    (tag,) = events.Tags()["images"]
    shown = next(event for event in events.Images(tag) if event.step == step)
    image = Image.open(io.BytesIO(shown.encoded_image_string))
    return image.resize((image.width * ENLARGED, image.height * ENLARGED), Image.NEAREST)


def keep(run, encoders, figures, float16=False):
    """Copy one run's encoder, write its JSON and its figure; returns the JSON's dict."""
    trained = json.loads((run / "result.json").read_text())
    name = trained["script"]
    result = {key: value for key, value in trained.items() if key not in ("args", "encoder")}
    result |= {"date": datetime.date.today().isoformat(), "commit": commit()}
    with open_shard(shard_path(trained["args"]["observations"], 0)) as shard:
        result["observations"] = attribute(shard, "made_by")
    result["args"] = {key: value for key, value in trained["args"].items() if key not in PATHS}
    encoders.mkdir(parents=True, exist_ok=True)
    for ending in (".pt", DECODER):
        if (run / f"encoder{ending}").exists():
            copy = to_float16 if float16 else shutil.copyfile
            copy(run / f"encoder{ending}", encoders / f"{name}{ending}")
    write_atomically(encoders / f"{name}.json", (json.dumps(result, indent=1) + "\n").encode())
    image = validation_image(run, trained["best_update"])
    image.save(figures / f"encoder_{name}.png", optimize=True)
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a finished run's folder")
    parser.add_argument("--encoders", type=Path, default=PRETRAINED, help="where networks go")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="where figures go")
    parser.add_argument("--float16", action="store_true", help="in half precision")
    args = parser.parse_args()
    for run in args.runs:
        if not (run / "result.json").exists():
            parser.error(f"{run} is no finished run (it has no result.json)")
    for run in args.runs:
        result = keep(run, args.encoders, args.figures, args.float16)
        print(f"{run}:", {key: value for key, value in result.items() if key != "args"})


if __name__ == "__main__":
    main()
