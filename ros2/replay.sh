#!/usr/bin/env bash
# Replay a bag through the node to an agent, on a machine with ROS 2:
#   replay.sh BAG DETECTOR.onnx "Pick up the mug on the table" [PARAMETER:=VALUE ...]
# Prints the node's last diagnostics and the mission's counts. Fails if no frame was mapped.
set -euo pipefail
if (($# < 3)); then
  echo 'replay.sh: expected BAG DETECTOR.onnx TASK [PARAMETER:=VALUE ...]' >&2
  exit 2
fi
bag=$1 detector=$2 task=$3
shift 3
out=$(mktemp -d)
listen=unix:$out/agent.sock
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT

gausslite-agent --agent-id replay --detector "$detector" --task "$task" --listen "$listen" --out "$out/mission" &
agent=$!
parameters=(-p "agent:=$listen" -p use_sim_time:=true)
for parameter in "$@"; do parameters+=(-p "$parameter"); done
# not through `ros2 run`, which does not pass signals on
"$(ros2 pkg prefix gausslite_ros)/lib/gausslite_ros/gausslite_node" --ros-args "${parameters[@]}" &
node=$!
ros2 topic echo --field status /diagnostics > "$out/diagnostics.txt" &
until ros2 node list | grep -q /gausslite; do
  kill -0 "$node" || { echo 'replay.sh: the node did not start' >&2; exit 1; }
done

ros2 bag play --clock 100 "$bag"
kill -TERM "$node"
wait "$node" || true
kill -TERM "$agent"
wait "$agent" || true
tail -n 60 "$out/diagnostics.txt"
python3 - "$out/mission/report.json" <<'PYTHON'
import json
import sys

report = json.load(open(sys.argv[1]))
print(f"frames mapped: {report['frames']}, Gaussians: {report['gaussians']}")
sys.exit(0 if report["frames"] > 0 else 1)
PYTHON
