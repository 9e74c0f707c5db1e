"""Makes and revokes the identities of a swarm's computers: an authority of its own, and what it signs for each of them.

An identity is a certificate for the address of a computer, and its private key. Nobody else's authority counts, so who
has no identity of the swarm is on none of its links. What is revoked is a certificate, not a name: the common name has
a random end, so that a computer's new identity is another one.
"""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from swarmctl.bus.network.identity_files import AUTHORITY, MOST_BYTES, REVOKED_FILE, certificate_file, key_file
from swarmctl.bus.network.keyring import read_certificate, revoked_serials
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import create_private, read_file, replace_bytes

_VALID = timedelta(days=3650)  # a swarm whose certificates expire in the field can't fly
_BEFORE = timedelta(days=1)  # a clock may be behind
_USAGES = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]

_Ip = ipaddress.IPv4Address | ipaddress.IPv6Address


def make_identities(folder: Path, addresses: Mapping[str, _Ip | None]) -> list[str]:
    """Make what is missing: the authority, and the identity of each computer; returns the names of those made.

    Args:
        folder: where the files are; it is made if need be.
        addresses: IP of each computer by name; None for one that nobody connects to.

    Raises:
        ConfigError: a file can't be read, there are certificates but not the authority's key, or a computer has an
            identity for another address.
        StartError: a file can't be written.
    """
    with _reported("keys init", folder):
        with _writing():
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        signer = _authority(folder, may_begin=True)
        made = [name for name in addresses if not (folder / certificate_file(name)).exists()]
        if moved := [name for name in addresses if name not in made and not _is_for(folder, name, addresses[name])]:
            problem = "another address now; swarmctl keys revoke it, then swarmctl keys add it"
            raise ConfigError("keys init", [f"{name}: {problem}" for name in moved])
        for name in made:
            _make(folder, name, signer, addresses[name])
    return made


def add_identity(folder: Path, name: str, address: _Ip | None) -> None:
    """Make one identity; the files of one that is revoked may still be there.

    Raises:
        ConfigError: it has one that counts, the authority's key is not there, or a file can't be read.
        StartError: a file can't be written.
    """
    with _reported("keys add", folder):
        authority, key = _authority(folder)
        if (folder / certificate_file(name)).exists():
            if read_certificate(folder, name).serial_number not in revoked_serials(folder, authority):
                raise ConfigError("keys add", [f"{name} has an identity; swarmctl keys revoke it first"])
            _remove(folder, name)
        _make(folder, name, (authority, key), address)


def revoke_identity(folder: Path, name: str) -> Path:
    """Put the certificate of a computer on the list of those that count no more; return the list's path.

    Its files go from this folder, so that a new one can be made.

    Raises:
        ConfigError: there is no such identity, the authority's key is not there, or a file can't be read.
        StartError: a file can't be written.
    """
    if name == AUTHORITY or Path(name).name != name:
        raise ConfigError("keys revoke", [f"{name!r}: name one of [[hosts]], or station"])
    if not (folder / certificate_file(name)).exists():
        raise ConfigError("keys revoke", [f"{name!r}: has no identity in {folder}; there are: {_named(folder)}"])
    with _reported("keys revoke", folder):
        authority, key = _authority(folder)
        revoked = revoked_serials(folder, authority) | {read_certificate(folder, name).serial_number}
        now = datetime.now(UTC)
        builder = x509.CertificateRevocationListBuilder().issuer_name(authority.subject)
        builder = builder.last_update(now).next_update(now + _VALID)
        for serial in sorted(revoked):
            entry = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(now).build()
            builder = builder.add_revoked_certificate(entry)
        written = builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
        with _writing():
            replace_bytes(folder / REVOKED_FILE, written)
        _remove(folder, name)
    return folder / REVOKED_FILE


@contextmanager
def _reported(verb: str, folder: Path) -> Iterator[None]:
    """Raise a ConfigError in place of what goes wrong with files that are there."""
    try:
        yield
    except OSError as error:
        raise ConfigError(verb, [f"{error.filename}: {error.strerror}"]) from error
    except ValueError as error:
        raise ConfigError(verb, [f"{folder}: holds a damaged certificate or key: {error}"]) from error


@contextmanager
def _writing() -> Iterator[None]:
    """Raise a StartError in place of what goes wrong with files that are written; one that is there is another matter.

    Raises:
        FileExistsError: as before.
    """
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        raise StartError(f"{error.filename}: can't be written: {error.strerror}") from error


def _make(folder: Path, name: str, signer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey], ip: _Ip | None) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    with _writing():
        (folder / key_file(name)).unlink(missing_ok=True)  # one without a certificate, as of a run that was cut off
    _write(folder, name, _signed(name, key.public_key(), signer, ip), key)


def _named(folder: Path) -> str:
    """Return the names of the identities in a folder."""
    names = sorted(file.stem for file in folder.glob(key_file("*")) if file.stem != AUTHORITY)
    return ", ".join(names) or "none"


def _remove(folder: Path, name: str) -> None:
    for file in (certificate_file(name), key_file(name)):  # the certificate says that both are there
        with _writing():
            (folder / file).unlink(missing_ok=True)


def _authority(folder: Path, *, may_begin: bool = False) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Return the authority of a folder; with `may_begin` a new one where there is none."""
    if may_begin and not (folder / certificate_file(AUTHORITY)).exists():
        new_key = ec.generate_private_key(ec.SECP256R1())
        name = _common_name("swarm authority")
        constraints = x509.BasicConstraints(ca=True, path_length=0)
        certificate = _begun(name, name, new_key.public_key()).add_extension(constraints, critical=True)
        signed = certificate.sign(new_key, hashes.SHA256())
        _write(folder, AUTHORITY, signed, new_key)
        return signed, new_key
    if not (folder / key_file(AUTHORITY)).exists():
        problem = f"{folder / key_file(AUTHORITY)} is not here; run this where the identities were made"
        raise ConfigError("keys", [problem])
    secret = read_file(folder / key_file(AUTHORITY), MOST_BYTES, private=True)
    key = serialization.load_pem_private_key(secret, password=None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ValueError("the authority's key is of another kind")
    return read_certificate(folder, AUTHORITY), key


def _signed(
    name: str,
    key: ec.EllipticCurvePublicKey,
    signer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey],
    address: _Ip | None,
) -> x509.Certificate:
    authority, authority_key = signer
    builder = _begun(_common_name(f"{name}.{secrets.token_hex(4)}"), authority.subject, key)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(x509.ExtendedKeyUsage(_USAGES), critical=False)
    if address is not None:
        builder = builder.add_extension(x509.SubjectAlternativeName([x509.IPAddress(address)]), critical=False)
    return builder.sign(authority_key, hashes.SHA256())


def _begun(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    builder = builder.serial_number(x509.random_serial_number())
    return builder.not_valid_before(now - _BEFORE).not_valid_after(now + _VALID)


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _is_for(folder: Path, name: str, address: _Ip | None) -> bool:
    """Return whether the certificate of a computer is for this address."""
    try:
        names = read_certificate(folder, name).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return address is None
    return names.get_values_for_type(x509.IPAddress) == [address]


def _write(folder: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    """Write the key before the certificate, whose presence says that both are there; or neither."""
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with _writing():
        create_private(folder / key_file(name), secret)
        try:
            create_private(folder / certificate_file(name), certificate.public_bytes(serialization.Encoding.PEM))
        except BaseException:
            (folder / key_file(name)).unlink(missing_ok=True)
            raise
