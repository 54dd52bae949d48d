#!/usr/bin/env bash
# Create a certificate authority, and a certificate for each name, to test encrypted services:
#   deploy/make_certificates.sh FOLDER NAME[:ROLE[:HOST]]...
# A name is a host, a compose service or an agent's --agent-id. A role is robot (default), viewer, operator, server
# for fusion servers that share a mission, or none for a service that calls no other. HOST is a further address (name or
# IPv4) under which others call it; a robot may also act under this name. An existing authority in FOLDER is reused.
# A team: FOLDER = certs, names server:none:HOST husky-1 operator:operator, where HOST is the address of parser and fusion server. Then
#   gausslite-fusion-server --listen 0.0.0.0:50052 --tls-cert certs/server/cert.pem --tls-key certs/server/key.pem --tls-ca certs/server/ca.pem
# and in the same way parser, agents and commands, each with the files of its own name.
# FOLDER/NAME gets ca.pem, cert.pem and key.pem: all that this service may read. Only FOLDER has the authority's key.
set -euo pipefail
fail() { echo "make_certificates: $1" >&2; exit 1; }
[ $# -ge 2 ] || fail "expected FOLDER NAME[:ROLE[:HOST]]..."
command -v openssl >/dev/null || fail "expected the program openssl, found none"
folder=$1
shift
days=${GAUSSLITE_CERT_DAYS:-90}
umask 077
mkdir -p "$folder"
new_key=(-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes)
[ -e "$folder/ca.pem" ] ||
  openssl req -x509 "${new_key[@]}" -keyout "$folder/ca.key" -out "$folder/ca.pem" -subj "/CN=GaussLite team" -days "$days" 2>/dev/null

for argument in "$@"; do
  IFS=: read -r name role host <<<"$argument"
  role=${role:-robot}
  [[ $name =~ ^[A-Za-z0-9][A-Za-z0-9._-]*$ ]] || fail "expected names of letters, digits and ._-, got '$name'"
  [[ $role =~ ^(robot|viewer|operator|server|none)$ ]] || fail "expected the role robot, viewer, operator, server or none, got '$role'"
  [[ $host =~ ^[A-Za-z0-9.-]*$ ]] || fail "expected a host's name or IPv4 address, got '$host'"
  kind=DNS
  [[ ! $host =~ ^[0-9.]+$ ]] || kind=IP
  own=$folder/$name
  mkdir -p "$own"
  openssl req "${new_key[@]}" -keyout "$own/key.pem" -out "$own/request" -subj "/CN=$name" 2>/dev/null
  openssl x509 -req -in "$own/request" -CA "$folder/ca.pem" -CAkey "$folder/ca.key" -CAcreateserial -days "$days" \
    -extfile <(echo "subjectAltName=DNS:$name,DNS:localhost,IP:127.0.0.1,URI:gausslite:role:$role${host:+,$kind:$host}") -out "$own/cert.pem" 2>/dev/null
  rm "$own/request"
  cp "$folder/ca.pem" "$own/ca.pem"
done
