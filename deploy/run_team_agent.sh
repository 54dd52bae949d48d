#!/usr/bin/env bash
# Run one of several equal containers as an agent of the team: each takes the first free number N of the volume /data, as
# agent-N. State and spool lie in /data/agent-N, so a restarted container continues the mission of its number.
#   TASKS, SOURCES   tasks and sequences, separated by ";"; agent N takes the Nth, and again the first after the last
#   MAX_AGENTS       highest number
# Arguments are passed on to gausslite-agent.
set -euo pipefail
fail() { echo "run-team-agent: $1" >&2; exit 2; }
: "${TASKS:?expected tasks}" "${SOURCES:?expected sequences}" "${MAX_AGENTS:=16}" "${DATA:=/data}"
[ -w "$DATA" ] || fail "$DATA: expected a folder that user $(id -u) can write, got one of user $(stat -c %u "$DATA"); run chown $(id -u) on it"

number=0
while [ $number -lt "$MAX_AGENTS" ]; do
  number=$((number + 1))
  folder=$DATA/agent-$number
  mkdir -p "$folder"
  # the lock lasts as long as the agent's process, also after exec
  exec 9>"$folder/lock"
  flock --nonblock 9 && break
  [ $number -lt "$MAX_AGENTS" ] || fail "MAX_AGENTS: expected more than the $number agents that run already"
done
IFS=';' read -ra tasks <<<"$TASKS"
IFS=';' read -ra sources <<<"$SOURCES"
index=$((number - 1))
# the seed differs, so that two agents with the same sequence and task have different maps
exec gausslite-agent --agent-id "agent-$number" --seed $index \
  --task "${tasks[index % ${#tasks[@]}]}" --source "${sources[index % ${#sources[@]}]}" \
  --state "$folder/mission.state" --spool "$folder/uplink.spool" --out "$folder" "$@"
