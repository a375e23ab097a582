//! Owns compressed video clips (MP4, AVI, Matroska), which an `ffmpeg` on the path decodes: formats and codecs of decades are no
//! work for this program. It hands over uncompressed pictures, one by one.

use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};

use super::ReadError;
use super::frames::push_planes;
use super::samples::Array;
use super::video::drop_equal_channels;

/// The most that a clip's frames may take, in bytes; a clip is so well compressed that its own size says nothing. Reading takes up
/// to three times as much: a vector that grows holds its content twice, and there is the frame on its way.
const LIMIT: usize = 256 << 20;
/// The longest line that the header of a picture may have.
const MAX_LINE: u64 = 64;

/// The name of a clip's format, if the bytes open like one.
pub fn kind(bytes: &[u8]) -> Option<&'static str> {
    match () {
        () if bytes.get(4..8) == Some(b"ftyp") => Some("MP4"),
        () if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"AVI ") => Some("AVI"),
        () if bytes.starts_with(b"\x1a\x45\xdf\xa3") => Some("Matroska"),
        () => None,
    }
}

/// Reads a clip's frames as `[T, C, H, W]`, 0 to 255; C = 1 if every pixel is gray, else 3.
///
/// # Errors
/// [`ReadError::NoFfmpeg`] if there is no `ffmpeg`; [`ReadError::Malformed`] with its words if it fails; [`ReadError::ClipTooLarge`].
pub fn read(path: &Path, kind: &'static str) -> Result<Array, ReadError> {
    read_with(OsStr::new("ffmpeg"), path, kind, LIMIT)
}

fn read_with(program: &OsStr, path: &Path, kind: &'static str, limit: usize) -> Result<Array, ReadError> {
    // A path could otherwise be taken for the address of a protocol, and a clip name other files and addresses to be read.
    let mut input = OsString::from("file:");
    input.push(path);
    let mut child = Command::new(program)
        .args(["-nostdin", "-v", "error", "-protocol_whitelist", "file,pipe", "-i"])
        .arg(input)
        .args(["-map", "0:v:0", "-pix_fmt", "rgb24", "-c:v", "ppm", "-f", "image2pipe", "pipe:1"])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|source| ReadError::NoFfmpeg { kind, source })?;
    let stdout = child.stdout.take().ok_or_else(|| bad(kind, "ffmpeg has no output"))?;
    let stderr = child.stderr.take().ok_or_else(|| bad(kind, "ffmpeg has no error output"))?;
    // It would wait if no one read what it complains about.
    let words = std::thread::spawn(move || {
        let mut words = Vec::new();
        stderr.take(1 << 14).read_to_end(&mut words).map(|_| words)
    });
    let video = read_pictures(&mut BufReader::new(stdout), kind, limit);
    if video.is_err() {
        // What it has to say after this is of no account; it may have ended by itself.
        let _ = child.kill();
    }
    let status = child.wait().map_err(ReadError::Io)?;
    let words = words.join().map_err(|_| bad(kind, "ffmpeg's words are lost"))?.map_err(ReadError::Io)?;
    let words = String::from_utf8_lossy(&words);
    if !status.success() && !matches!(video, Err(ReadError::ClipTooLarge { .. })) {
        return Err(bad(kind, format!("ffmpeg ends with {status}: {}", words.trim())));
    }
    video
}

fn bad(format: &'static str, reason: impl Into<String>) -> ReadError {
    ReadError::Malformed { format, reason: reason.into() }
}

/// Binary PPM pictures of one size, until there are no more.
fn read_pictures(r: &mut impl BufRead, kind: &'static str, limit: usize) -> Result<Array, ReadError> {
    let mut planes = Vec::new();
    let mut size = None;
    let mut frames = 0;
    while let Some((width, height)) = read_header(r, kind)? {
        if *size.get_or_insert((width, height)) != (width, height) {
            return Err(bad(kind, format!("frame {frames} has {width}×{height} pixels, but the first another size")));
        }
        let bytes = width.saturating_mul(height).saturating_mul(3);
        if bytes.saturating_mul(frames + 1) > limit {
            return Err(ReadError::ClipTooLarge { kind, limit });
        }
        let mut picture = vec![0; bytes];
        r.read_exact(&mut picture).map_err(|e| bad(kind, format!("frame {frames} from ffmpeg: {e}")))?;
        push_planes(&mut planes, &picture, 3);
        frames += 1;
    }
    let Some((width, height)) = size else { return Err(bad(kind, "no frames")) };
    drop_equal_channels(planes, frames, height, width)
}

/// Width and height of the picture that begins here.
fn read_header(r: &mut impl BufRead, kind: &'static str) -> Result<Option<(usize, usize)>, ReadError> {
    let mut words = Vec::new();
    while words.len() < 4 {
        let mut line = String::new();
        r.take(MAX_LINE).read_line(&mut line).map_err(ReadError::Io)?;
        if line.is_empty() && words.is_empty() {
            return Ok(None);
        }
        if !line.ends_with('\n') {
            return Err(bad(kind, "ffmpeg gave something other than pictures"));
        }
        words.extend(line.split_ascii_whitespace().map(str::to_owned));
    }
    let side = |word: &str| word.parse().ok().filter(|n| (1..=1 << 16).contains(n));
    match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["P6", width, height, "255"] => side(width).zip(side(height)).map(Some),
        _ => None,
    }
    .ok_or_else(|| bad(kind, format!("ffmpeg gave a picture that begins with {words:?}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::samples::{SampleType, Samples};

    #[test]
    fn clips_are_told_by_their_first_bytes() {
        assert_eq!(kind(b"\0\0\0\x20ftypisom"), Some("MP4"));
        assert_eq!(kind(b"RIFF\0\0\0\0AVI LIST"), Some("AVI"));
        assert_eq!(kind(b"RIFF\0\0\0\0WAVE"), None);
        assert_eq!(kind(b""), None);
    }

    #[test]
    fn pictures_become_a_video() {
        let stream = b"P6\n2 1\n255\n\x01\x02\x03\x04\x05\x06P6\n2 1\n255\n\x07\x07\x07\x08\x08\x08";
        let video = read_pictures(&mut &stream[..], "MP4", 1 << 20).unwrap();
        assert_eq!((video.shape(), video.stored()), (&[2, 3, 1, 2][..], SampleType::U8));
        assert_eq!(video.samples(), &Samples::Bytes(vec![1, 4, 2, 5, 3, 6, 7, 8, 7, 8, 7, 8]));
        let gray = read_pictures(&mut &stream[17..], "MP4", 1 << 20).unwrap();
        assert_eq!((gray.shape(), gray.samples()), (&[1, 1, 1, 2][..], &Samples::Bytes(vec![7, 8])));
        for len in 1..stream.len() {
            if len != 17 {
                assert!(read_pictures(&mut &stream[..len], "MP4", 1 << 20).is_err(), "{len} bytes");
            }
        }
        let error = read_pictures(&mut &stream[..], "MP4", 11).unwrap_err();
        assert!(matches!(error, ReadError::ClipTooLarge { .. }), "{error}");
        assert!(read_pictures(&mut &b"P6\n99999999 99999999\n255\n"[..], "MP4", 1 << 20).is_err());
    }

    #[test]
    fn without_an_ffmpeg_the_message_says_what_to_do() {
        let error = read_with(OsStr::new("no-such-ffmpeg"), Path::new("a.mp4"), "MP4", LIMIT).unwrap_err().to_string();
        assert!(error.contains("MP4") && error.contains("ffmpeg") && error.contains("path"), "{error}");
    }

    /// Stands in for ffmpeg: a script that ends as it is told.
    #[cfg(unix)]
    #[test]
    fn what_ffmpeg_says_and_gives_is_handed_on() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        let script = |name: &str, text: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
            path
        };
        let good = script("good", r"printf 'P6\n2 1\n255\n\001\002\003\004\005\006'");
        let video = read_with(good.as_os_str(), Path::new("a.mp4"), "MP4", LIMIT).unwrap();
        assert_eq!(video.shape(), [1, 3, 1, 2]);
        let failing = script("failing", "echo moov atom not found >&2; exit 1");
        let error = read_with(failing.as_os_str(), Path::new("a.mp4"), "MP4", LIMIT).unwrap_err().to_string();
        assert!(error.contains("moov atom not found"), "{error}");
    }
}
