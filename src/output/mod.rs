//! Files on their way to the disk: none of them is one that is read, and what is not a stream is
//! complete or not there.

mod files;
mod new_file;

pub use files::{FileNamed, Files, FilesError, resolved};
pub use new_file::{NewFile, write};
