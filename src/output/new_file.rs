//! Files that appear when they are complete.

use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::files::resolved;

/// A file that is written beside its place and moved there by [`Self::finish`]; without that,
/// nothing is left of it, and what had its name before stays. Links are followed; pipes and devices
/// are written to as they are.
#[derive(Debug)]
pub struct NewFile {
    writer: Writer,
    target: PathBuf,
}

#[derive(Debug)]
enum Writer {
    Beside(NamedTempFile),
    Through(File),
}

impl NewFile {
    /// # Errors
    /// If no file can be created there.
    pub fn create(path: &Path) -> io::Result<Self> {
        let found = fs::metadata(path).ok();
        let target = resolved(path);
        if found.as_ref().is_some_and(|found| !found.is_file() && !found.is_dir()) {
            let writer = Writer::Through(OpenOptions::new().write(true).open(path)?);
            return Ok(Self { writer, target });
        }
        if found.as_ref().is_some_and(|found| found.is_dir()) {
            return Err(io::ErrorKind::IsADirectory.into());
        }
        let folder = target.parent().unwrap_or(Path::new("/"));
        // What a plain creation gives, less the umask.
        let usual = Permissions::from_mode(0o666);
        let permissions = found.map_or(usual, |found| found.permissions());
        let mut builder = tempfile::Builder::new();
        builder.prefix(".").suffix(".partial").permissions(permissions);
        let writer = Writer::Beside(builder.tempfile_in(folder).map_err(|error| error_of(&error))?);
        Ok(Self { writer, target })
    }

    /// Where the content lies until it is complete, for those who open files by name.
    pub fn path(&self) -> &Path {
        match &self.writer {
            Writer::Beside(file) => file.path(),
            Writer::Through(_) => &self.target,
        }
    }

    /// Moves the file to its place.
    ///
    /// # Errors
    /// If the disk refuses.
    pub fn finish(self) -> io::Result<()> {
        match self.writer {
            Writer::Beside(file) => file.persist(&self.target).map(|_| ()).map_err(|e| e.error),
            Writer::Through(mut file) => file.flush(),
        }
    }
}

/// Without the name of the temporary file, which means nothing to the user.
fn error_of(error: &io::Error) -> io::Error {
    error.kind().into()
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.writer {
            Writer::Beside(file) => file.as_file_mut().write(bytes),
            Writer::Through(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match &mut self.writer {
            Writer::Beside(file) => file.as_file_mut().flush(),
            Writer::Through(file) => file.flush(),
        }
    }
}

/// Writes a whole file, as [`NewFile`] does.
///
/// # Errors
/// If it cannot be created or written to its end; then there is none.
pub fn write(path: &Path, content: impl AsRef<[u8]>) -> io::Result<()> {
    let mut file = NewFile::create(path)?;
    file.write_all(content.as_ref())?;
    file.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<_> =
            entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_complete_or_what_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.json");
        write(&path, "old").unwrap();
        let mut file = NewFile::create(&path).unwrap();
        file.write_all(b"half of the n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        drop(file);
        assert_eq!(names(folder.path()), ["metrics.json"]);
        write(&path, "new").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        assert_eq!(names(folder.path()), ["metrics.json"]);
    }

    #[test]
    fn links_lead_to_the_file_and_permissions_stay() {
        let folder = tempfile::tempdir().unwrap();
        let (file, link) = (folder.path().join("file"), folder.path().join("link"));
        std::os::unix::fs::symlink("file", &link).unwrap();
        write(&link, "through a dangling link").unwrap();
        assert!(link.is_symlink() && file.is_file());
        fs::set_permissions(&file, Permissions::from_mode(0o640)).unwrap();
        write(&link, "again").unwrap();
        assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o640);
        assert_eq!(fs::read_to_string(&file).unwrap(), "again");
    }

    #[test]
    fn places_that_take_no_file_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        assert!(write(folder.path(), "").is_err());
        assert!(write(&folder.path().join("absent/file"), "").is_err());
        write(Path::new("/dev/null"), "to a device").unwrap();
        assert!(write(Path::new("/dev/full"), "to a full device").is_err());
    }
}
