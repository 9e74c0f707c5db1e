"""What one identity knows of the others: whose certificates it trusts, and the keys of seals that follow from them.

Two identities share a key that nobody else has: Diffie-Hellman of the own private key and the public one in the other's
certificate (P-256), so there is no secret to hand out beside the private keys. A certificate is trusted if the
authority has signed it and not revoked it. Its period is no matter here: computers in the field boot with any date, and
the links of routers check it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from swarmctl.bus.network.identity_files import (
    AUTHORITY,
    MOST_BYTES,
    REVOKED_FILE,
    certificate_file,
    identity_problems,
    key_file,
)
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.network.seals import KEY_BYTES, PairKeys
from swarmctl.errors import ConfigError
from swarmctl.files import read_file

_PERSON = b"swarmctl bus"  # of the keys of seals; who uses the same private key for something else gets other keys


@dataclass(frozen=True, slots=True, kw_only=True)
class Keyring:
    """Holds what the files of one identity say.

    Attributes:
        keys: shared with each identity of the roster, in its order; None where no certificate is trusted.
        common_names: of the trusted certificates, by identity.
    """

    keys: PairKeys
    common_names: Mapping[str, str]


def load_keyring(identity: OwnIdentity) -> Keyring:
    """Read the certificates that are trusted, and derive the keys that are shared with each.

    Raises:
        ConfigError: the own files can't be used, or a file is damaged.
    """
    with _reported(identity):
        folder = Path(identity.folder)
        trusted, _ = _trusted(folder, identity)
        return Keyring(keys=_shared_keys(folder, identity, trusted), common_names=_common_names(trusted))


def refuse_distrusted(identity: OwnIdentity) -> None:
    """Check before a flight that every host has a certificate that counts; only the station's may be missing.

    In flight nobody asks: who is revoked meanwhile must not keep others from starting a router again.

    Raises:
        ConfigError: one has none, or the own files can't be used.
    """
    with _reported(identity):
        _, problems = _trusted(Path(identity.folder), identity)
        needed = [speaker.name for speaker in identity.roster.speakers if speaker.agents] + [identity.name]
        if found := [problems[name] for name in dict.fromkeys(needed) if name in problems]:
            raise ConfigError(identity.name, found)
        load_keyring(identity)


@contextmanager
def _reported(identity: OwnIdentity) -> Iterator[None]:
    """Raise a ConfigError in place of what goes wrong with the files of an identity."""
    folder = Path(identity.folder)
    if problems := list(identity_problems(folder, identity.name)):
        raise ConfigError(identity.name, problems)
    try:
        yield
    except OSError as error:
        raise ConfigError(identity.name, [f"bus.identities: {error.filename}: {error.strerror}"]) from error
    except ValueError as error:
        raise ConfigError(identity.name, [f"bus.identities: {folder} holds a damaged file: {error}"]) from error


def revoked_serials(folder: Path, authority: x509.Certificate) -> frozenset[int]:
    """Return the serial numbers of the certificates that the authority has revoked.

    Raises:
        OSError: the list can't be read; a missing one is empty.
        ValueError: it is not by this authority.
    """
    try:
        text = read_file(folder / REVOKED_FILE, MOST_BYTES)
    except FileNotFoundError:
        return frozenset()
    revoked, signer = x509.load_pem_x509_crl(text), authority.public_key()
    if not isinstance(signer, ec.EllipticCurvePublicKey) or not revoked.is_signature_valid(signer):
        raise ValueError(f"{REVOKED_FILE} is not by the authority of this swarm")
    return frozenset(entry.serial_number for entry in revoked)


def read_certificate(folder: Path, name: str) -> x509.Certificate:
    """Return a certificate of a folder.

    Raises:
        OSError: it can't be read.
        ValueError: it is none.
    """
    return x509.load_pem_x509_certificate(read_file(folder / certificate_file(name), MOST_BYTES))


def _trusted(folder: Path, identity: OwnIdentity) -> tuple[dict[str, x509.Certificate], dict[str, str]]:
    """Return the certificates that count, by identity, and why those of others do not."""
    authority = read_certificate(folder, AUTHORITY)
    revoked = revoked_serials(folder, authority)
    found, problems = dict[str, x509.Certificate](), dict[str, str]()
    for speaker in identity.roster.speakers:
        problem, certificate = _judged(folder, speaker.name, authority, revoked)
        if certificate is None:
            problems[speaker.name] = problem
        else:
            found[speaker.name] = certificate
    return found, problems


def _judged(
    folder: Path, name: str, authority: x509.Certificate, revoked: frozenset[int]
) -> tuple[str, x509.Certificate | None]:
    """Return why a certificate does not count, or the certificate."""
    where = f"bus.identities: {folder / certificate_file(name)}"
    try:
        certificate = read_certificate(folder, name)
    except FileNotFoundError:
        return f"{where}: missing; copy it from the computer on which swarmctl keys has made it", None
    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, ValueError, TypeError):
        return f"{where}: is not by the authority of this swarm", None
    if certificate.serial_number in revoked:
        return f"{where}: is revoked; give {name} a new identity (swarmctl keys add), or take it out of [[hosts]]", None
    if _common_name(certificate).partition(".")[0] != name:
        return f"{where}: is of {_common_name(certificate)}, not of {name}", None
    return "", certificate


def _shared_keys(
    folder: Path, identity: OwnIdentity, trusted: Mapping[str, x509.Certificate]
) -> tuple[bytes | None, ...]:
    secret = read_file(folder / key_file(identity.name), MOST_BYTES, private=True)
    private = serialization.load_pem_private_key(secret, password=None)
    if not isinstance(private, ec.EllipticCurvePrivateKey):
        raise ValueError(f"{key_file(identity.name)} is of another kind")
    own = _public(private.public_key())
    if own != _public(read_certificate(folder, identity.name).public_key()):
        raise ValueError(f"{key_file(identity.name)} is not the key of {certificate_file(identity.name)}")
    names = (speaker.name for speaker in identity.roster.speakers)
    return tuple(_shared(private, own, trusted[name]) if name in trusted else None for name in names)


def _shared(private: ec.EllipticCurvePrivateKey, own: bytes, certificate: x509.Certificate) -> bytes:
    public = certificate.public_key()
    if not isinstance(public, ec.EllipticCurvePublicKey):
        raise ValueError("a certificate is of another kind")
    secret = private.exchange(ec.ECDH(), public)
    both = b"".join(sorted((own, _public(public))))
    return blake2b(secret + both, digest_size=KEY_BYTES, person=_PERSON).digest()


def _public(key: object) -> bytes:
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise ValueError("a certificate is of another kind")
    return key.public_bytes(serialization.Encoding.X962, serialization.PublicFormat.UncompressedPoint)


def _common_names(certificates: Mapping[str, x509.Certificate]) -> dict[str, str]:
    return {name: _common_name(certificate) for name, certificate in certificates.items()}


def _common_name(certificate: x509.Certificate) -> str:
    (found,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME) or (None,)
    return "" if found is None else str(found.value)
