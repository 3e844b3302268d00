"""Client config files, engine settings, the shared secret, and the places of shipped files."""

from rce.config.exceptions import ConfigError, Fault, LogFileError, RunDirError, SecretError, ShippedFileError
from rce.config.fields import Field, SettingError, fields_of, sections_of
from rce.config.folders import (
    ETCD_FILE,
    MASTER_FOLDER,
    STORE_FILE,
    configs_dir,
    default_state_dir,
    examples_dir,
    run_dir,
)
from rce.config.loading import as_document, handed_over, load_settings, read_document
from rce.config.logs import log_as, redact, start_logging
from rce.config.secret import (
    Secret,
    default_secret_file,
    load_secret,
    new_secret,
    retire_secrets,
    rotate_secret,
)
from rce.config.settings import ANYWHERE, LOOPBACK, EngineSettings, MasterSettings, Runtime
from rce.config.store_address import EtcdAddress, SqliteAddress, StoreAddress, read_store_address

__all__ = [
    "ANYWHERE",
    "ETCD_FILE",
    "LOOPBACK",
    "MASTER_FOLDER",
    "STORE_FILE",
    "ConfigError",
    "EngineSettings",
    "EtcdAddress",
    "Fault",
    "Field",
    "LogFileError",
    "MasterSettings",
    "RunDirError",
    "Runtime",
    "Secret",
    "SecretError",
    "SettingError",
    "ShippedFileError",
    "SqliteAddress",
    "StoreAddress",
    "as_document",
    "configs_dir",
    "default_secret_file",
    "default_state_dir",
    "examples_dir",
    "fields_of",
    "handed_over",
    "load_secret",
    "load_settings",
    "log_as",
    "new_secret",
    "read_document",
    "read_store_address",
    "redact",
    "retire_secrets",
    "rotate_secret",
    "run_dir",
    "sections_of",
    "start_logging",
]
