#!/usr/bin/env bash
# Run the team of compose.yaml on this machine's container engine, and check that it survives:
#   deploy/smoke_test.sh [--tls] [--no-build]
# It builds the images, starts parser, fusion server and two agents, kills each kind of service once, refines the fused map from outside, waits
# for the end of all missions, and deletes the team with its volumes. --tls: with compose.tls.yaml and new certificates; a caller without one must be
# refused. The host needs docker compose and an installed gausslite.
set -euo pipefail
cd "$(dirname "$0")/.."
tls='' build=--build certificate=()
for argument in "$@"; do
  case $argument in
    --tls) tls=yes ;;
    --no-build) build=--no-build ;;
    *) echo "smoke test: expected --tls or --no-build, got $argument" >&2; exit 2 ;;
  esac
done
export COMPOSE_PROJECT_NAME=gausslite-smoke GAUSSLITE_AGENTS=2 COMPOSE_FILE=compose.yaml${tls:+:deploy/compose.tls.yaml}
export GAUSSLITE_FUSION_PORT=${GAUSSLITE_FUSION_PORT:-50152} GAUSSLITE_PARSER_PORT=${GAUSSLITE_PARSER_PORT:-50151}
fusion=127.0.0.1:$GAUSSLITE_FUSION_PORT
out=$(mktemp -d)
say() { echo "smoke test: $*"; }
fail() { say "FAILED: $*"; docker compose logs --no-color --tail 50; exit 1; }
trap 'say "FAILED in line $LINENO"' ERR

give_certificates() { # USER: the containers' user reads its folders; the host's user deletes them
  docker run --rm --network none --user 0 --volume "$out/certs:/certs" --entrypoint sh "$(docker compose config --images | grep parser)" \
    -c "cd /certs && chown -R $1 parser fusion-server agent-1 agent-2"
}
clean_up() {
  docker compose down --volumes --timeout 5 >/dev/null 2>&1
  [ ! -d "$out/certs" ] || give_certificates "$(id -u)"
  rm -rf "$out"
}
trap clean_up EXIT

team() { gausslite "$@" "${certificate[@]}"; }
agent_container() { # INDEX: the options of `docker compose port` that name it
  if [ -n "$tls" ]; then echo "agent-$1"; else echo "--index $1 agent"; fi
}
# sed reads to the end: head would end the listing with SIGPIPE, which pipefail reports
container() { docker compose ps --all --quiet "$1" | sed -n 1p; }
agent_status() { # INDEX: the state in the first line of `gausslite status`
  # shellcheck disable=SC2046
  team status "$(docker compose port $(agent_container "$1") 50053)" | sed -n '1s/.*: //p'
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
has_keyframes() { [ "$(team status "$fusion" | sed -n 's/^keyframes *\([0-9]*\).*/\1/p')" -ge 2 ]; }
all_ended() {
  for index in 1 2; do [ "$(agent_status "$index")" = ended ] || return 1; done
}

[ $build = --no-build ] || docker compose build --quiet
if [ -n "$tls" ]; then
  deploy/make_certificates.sh "$out/certs" parser:none fusion-server:none agent-1 agent-2 operator:operator
  give_certificates 10001
  operator=$out/certs/operator
  export GAUSSLITE_CERTS=$out/certs
  certificate=(--tls-cert "$operator/cert.pem" --tls-key "$operator/key.pem" --tls-ca "$operator/ca.pem")
fi
docker compose up --no-build --detach --wait || fail "the team did not start"
if [ -n "$tls" ]; then
  ! gausslite status "$fusion" --tls-ca "$out/certs/ca.pem" || fail "a caller without a certificate was answered"
fi
wait_until 600 "two keyframes are on the server" has_keyframes
team refine "$fusion" --iterations 20 --out "$out/during.ply" || fail "refining during the mission"
for service in agent${tls:+-1} fusion-server parser; do kill_service "$service"; done
wait_until 1800 "both missions ended" all_ended
team status "$fusion"
team refine "$fusion" --iterations 20 --out "$out/refined.ply" || fail "refining after the mission"
team fetch "$fusion" --out "$out/fused.ply" || fail "fetching the fused map"
won=$(team status "$fusion" | grep -c 'wins [1-9]')
[ "$won" -eq 2 ] || fail "expected two agents that win voxels, got $won"
say "passed"
