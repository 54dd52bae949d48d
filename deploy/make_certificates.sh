#!/usr/bin/env bash
# Create a certificate authority, and a certificate for each name, to test encrypted services:
#   deploy/make_certificates.sh FOLDER NAME...
# A name is a host, a compose service or an agent's --agent-id. An existing authority in FOLDER is reused.
set -euo pipefail
fail() { echo "make_certificates: $1" >&2; exit 1; }
[ $# -ge 2 ] || fail "expected FOLDER NAME..."
command -v openssl >/dev/null || fail "expected the program openssl, found none"
folder=$1
shift
days=${GAUSSLITE_CERT_DAYS:-90}
umask 077
mkdir -p "$folder"
new_key=(-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes)
[ -e "$folder/ca.pem" ] ||
  openssl req -x509 "${new_key[@]}" -keyout "$folder/ca.key" -out "$folder/ca.pem" -subj "/CN=GaussLite team" -days "$days" 2>/dev/null

for name in "$@"; do
  [[ $name =~ ^[A-Za-z0-9][A-Za-z0-9._-]*$ ]] || fail "expected names of letters, digits and ._-, got '$name'"
  openssl req "${new_key[@]}" -keyout "$folder/$name.key" -out "$folder/$name.csr" -subj "/CN=$name" 2>/dev/null
  openssl x509 -req -in "$folder/$name.csr" -CA "$folder/ca.pem" -CAkey "$folder/ca.key" -CAcreateserial -days "$days" \
    -extfile <(echo "subjectAltName=DNS:$name,DNS:localhost,IP:127.0.0.1") -out "$folder/$name.pem" 2>/dev/null
  rm "$folder/$name.csr"
done
chmod 644 "$folder"/*.pem
