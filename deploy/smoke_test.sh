#!/usr/bin/env bash
# Run the team of compose.yaml on this machine's container engine, and check that it survives:
#   deploy/smoke_test.sh [AGENTS] [--no-build]
# It builds the images, starts the team, kills each kind of service once, refines the fused map from outside, waits for the
# end of all missions, and deletes the team with its volumes. The host needs docker compose and an installed gausslite.
set -euo pipefail
cd "$(dirname "$0")/.."
agents=${1:-2}
export GAUSSLITE_AGENTS=$agents COMPOSE_PROJECT_NAME=gausslite-smoke GAUSSLITE_FUSION_PORT=${GAUSSLITE_FUSION_PORT:-50152}
fusion=127.0.0.1:$GAUSSLITE_FUSION_PORT
out=$(mktemp -d)
say() { echo "smoke test: $*"; }
fail() { say "FAILED: $*"; docker compose logs --no-color --tail 50; exit 1; }
trap 'say "FAILED in line $LINENO"' ERR
trap 'docker compose down --volumes --timeout 5 >/dev/null 2>&1; rm -rf "$out"' EXIT

# sed reads to the end: head would end the listing with SIGPIPE, which pipefail reports
container() { docker compose ps --all --quiet "$1" | sed -n 1p; }
agent_status() { # SERVICE INDEX: the state in the first line of `gausslite status`
  gausslite status "$(docker compose port --index "$1" agent 50053)" | sed -n '1s/.*: //p'
}
wait_until() { # SECONDS TEXT COMMAND...: repeat the command until it succeeds
  local limit=$1 what=$2 start=$SECONDS
  shift 2
  until "$@"; do
    [ $((SECONDS - start)) -lt "$limit" ] || fail "$what: not within $limit s"
    sleep 2
  done
  say "$what after $((SECONDS - start)) s"
}
healthy_after() { # CONTAINER RESTARTS
  [ "$(docker inspect -f '{{.RestartCount}} {{.State.Health.Status}}' "$1")" = "$2 healthy" ]
}
kill_service() { # SERVICE: end its process with SIGKILL, from inside, so that the restart policy applies
  local id restarts
  id=$(container "$1")
  restarts=$(docker inspect -f '{{.RestartCount}}' "$id")
  docker exec "$id" python -c '
import os, signal
own = os.getpid()
for pid in (int(name) for name in os.listdir("/proc") if name.isdigit()):
    if pid not in (1, own):
        os.kill(pid, signal.SIGKILL)' || true
  wait_until 180 "$1 is healthy again" healthy_after "$id" $((restarts + 1))
}
has_keyframes() { [ "$(gausslite status "$fusion" | sed -n 's/^keyframes *\([0-9]*\).*/\1/p')" -ge 2 ]; }
all_ended() {
  for index in $(seq "$agents"); do [ "$(agent_status "$index")" = ended ] || return 1; done
}

[ "${2:-}" = --no-build ] || docker compose build --quiet
docker compose up --detach --wait || fail "the team did not start"
wait_until 600 "two keyframes are on the server" has_keyframes
gausslite refine "$fusion" --iterations 20 --out "$out/during.ply" || fail "refining during the mission"
for service in agent fusion-server parser; do kill_service "$service"; done
wait_until 1800 "all $agents missions ended" all_ended
gausslite status "$fusion"
gausslite refine "$fusion" --iterations 20 --out "$out/refined.ply" || fail "refining after the mission"
gausslite fetch "$fusion" --out "$out/fused.ply" || fail "fetching the fused map"
won=$(gausslite status "$fusion" | grep -c 'wins [1-9]')
[ "$won" -eq "$agents" ] || fail "expected $agents agents that win voxels, got $won"
say "passed"
