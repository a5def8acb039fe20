"""`liir certs`: a CA, and a folder for each role with its certificate and token, for development.

    ca.pem, ca-key.pem                       stay where they were made
    ROLE/ca.pem, cert.pem, key.pem, tokens   all that a machine of the role needs: `security: FOLDER/ROLE`
    actor/ray-token                          of Ray's nodes among themselves: RAY_AUTH_TOKEN_PATH

The roles are `learner`, which has everybody's tokens, and those of `Role`, which have their own.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from liir_common.errors import ConfigError
from liir_common.files import write_atomic
from liir_common.rpc.tokens import Role, Tokens

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
_CA_DAYS, _DAYS = 3650, 365
_CLOCK_SKEW = timedelta(days=2)
"""New certificates hold for a machine whose clock is as much slow."""
_PRIVATE = 0o600
_HOST_NAME = re.compile(r"(\*\.)?[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*")
_TOKEN_BYTES = 32


def make_certs(folder: Path, hosts: Sequence[str] = ()) -> None:
    """Write the CA and every role's folder; again, renew all certificates and hand out the tokens anew.

    A CA, the learner's tokens and Ray's that are there already are kept. The learner's certificate holds for
    this machine's loopback names and for `hosts`, names or IP addresses.

    Raises:
        ConfigError: the CA or the learner's tokens in `folder` cannot be used, or a host is none.
    """
    names = [_general_name(host) for host in dict.fromkeys((*LOCAL_HOSTS, *hosts))]
    for role in ("learner", *Role):
        (folder / role).mkdir(parents=True, exist_ok=True)
    ca, ca_key = _load_ca(folder) if (folder / "ca.pem").exists() else _make_ca(folder)
    # `liir train` shows the learner's certificate as a client, too: its processes share one configuration.
    both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    _issue(folder / "learner", ca, ca_key, both, names)
    for role in Role:
        _issue(folder / role, ca, ca_key, [ExtendedKeyUsageOID.CLIENT_AUTH], [])
    _hand_out_tokens(folder)
    ray_token = folder / Role.ACTOR / "ray-token"
    if not ray_token.exists():
        write_atomic(ray_token, secrets.token_hex(_TOKEN_BYTES).encode(), _PRIVATE)


def _hand_out_tokens(folder: Path) -> None:
    """Give each role its lines of the learner's tokens file, which is written if it is missing."""
    path = folder / "learner" / "tokens"
    if not path.exists():
        lines = [f"{role} {secrets.token_urlsafe(_TOKEN_BYTES)}\n" for role in Role]
        write_atomic(path, "".join(lines).encode(), _PRIVATE)
    Tokens(str(path))  # raises here what would else stop the learner
    for role in Role:
        own = [line for line in path.read_bytes().splitlines() if line.split()[:1] == [role.encode()]]
        write_atomic(folder / role / "tokens", b"".join(line + b"\n" for line in own), _PRIVATE)


def _general_name(host: str) -> x509.GeneralName:
    with suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(host))
    if not _HOST_NAME.fullmatch(host):
        raise ConfigError(f"wanted a host's name or IP address without a port, got {host!r}")
    return x509.DNSName(host)


def _make_ca(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("LIIR development CA")
    usage = _key_usage(signs_certificates=True)
    certificate = (
        _builder(name, name, key.public_key(), _CA_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )
    write_atomic(folder / "ca-key.pem", _pem(key), _PRIVATE)
    write_atomic(folder / "ca.pem", certificate.public_bytes(Encoding.PEM))
    return certificate, key


def _load_ca(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    try:
        certificate = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
        key = load_pem_private_key((folder / "ca-key.pem").read_bytes(), password=None)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{folder} holds a CA that cannot sign ({error}); restore ca-key.pem, or name another folder"
        ) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise ConfigError(f"{folder}: ca-key.pem is not the key of ca.pem; name another folder with -o")
    return certificate, key


def _issue(
    folder: Path,
    ca: x509.Certificate,
    ca_key: ec.EllipticCurvePrivateKey,
    purposes: Sequence[x509.ObjectIdentifier],
    names: Sequence[x509.GeneralName],
) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(_name(f"LIIR {folder.name}"), ca.subject, key.public_key(), _DAYS)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key()), critical=False
        )
    )
    if names:
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    certificate = builder.sign(ca_key, hashes.SHA256())
    write_atomic(folder / "ca.pem", ca.public_bytes(Encoding.PEM))
    write_atomic(folder / "key.pem", _pem(key), _PRIVATE)
    write_atomic(folder / "cert.pem", certificate.public_bytes(Encoding.PEM))


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SKEW)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _key_usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
