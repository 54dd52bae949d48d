#!/usr/bin/env bash
# Run one of several equal containers as an agent of the team. Each takes the first free number N of the volume, and is
# agent-N. State and spool lie in the volume's folder agent-N, so a restarted container continues the mission of its number.
#   TASKS, SOURCES   tasks and sequences, separated by ";"; agent N takes the Nth, and again the first after the last
#   AGENT_NUMBER     take this number, for a container with a volume of its own
#   MAX_AGENTS       highest number (16)
#   DATA             the volume's folder (/data)
# Arguments are passed on to gausslite-agent.
set -euo pipefail
fail() { echo "run-team-agent: $1" >&2; exit 2; }
: "${DATA:=/data}" "${MAX_AGENTS:=16}"
[ -n "${TASKS:-}" ] || fail 'TASKS: expected tasks separated by ";", got nothing'
[ -n "${SOURCES:-}" ] || fail 'SOURCES: expected sequences separated by ";", got nothing'
[ -w "$DATA" ] || fail "$DATA: expected a folder that user $(id -u) can write, got one of user $(stat -c %u "$DATA"); run chown -R $(id -u) on it"

take() { # NUMBER: succeed if no other agent has it; the lock lasts as long as this process, also after exec
  folder=$DATA/agent-$1
  mkdir -p "$folder"
  exec 9>"$folder/lock"
  flock --nonblock 9
}
if [ -n "${AGENT_NUMBER:-}" ]; then
  number=$AGENT_NUMBER
  take "$number" || fail "AGENT_NUMBER: expected a number without a running agent, got $number"
else
  number=1
  until take $number; do
    number=$((number + 1))
    [ $number -le "$MAX_AGENTS" ] || fail "MAX_AGENTS: expected more than the $MAX_AGENTS agents that run already"
  done
fi

IFS=';' read -ra tasks <<<"$TASKS"
IFS=';' read -ra sources <<<"$SOURCES"
index=$((number - 1))
# the seed differs, so that two agents with the same sequence and task have different maps
exec gausslite-agent --agent-id "agent-$number" --set seed=$index \
  --task "${tasks[index % ${#tasks[@]}]}" --source "${sources[index % ${#sources[@]}]}" \
  --state "$folder/mission.state" --set spool="$folder/uplink.spool" --out "$folder" "$@"
