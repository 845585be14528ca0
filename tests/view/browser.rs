//! A headless browser, driven through a page that it loads from a server of the test's own.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Chromium, if there is one: `ISOLUME_CHROMIUM`, or by its names on the path.
pub(crate) fn find() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("ISOLUME_CHROMIUM") {
        return Some(path.into());
    }
    let folders = std::env::var_os("PATH")?;
    let names = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
    std::env::split_paths(&folders).flat_map(|d| names.map(|n| d.join(n))).find(|p| p.is_file())
}

pub(crate) fn command(program: &Path, profile: &Path) -> Command {
    let mut command = Command::new(program);
    command.args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]);
    command
        .args(["--enable-logging=stderr", "--hide-scrollbars"])
        .arg(format!("--user-data-dir={}", profile.display()));
    command
}

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Loads `page` with `driver` run after it, and returns what it posts, by name, until it posts `done`. Errors of the
/// page are posted as `error`.
pub(crate) fn drive(program: &Path, page: &str, driver: &str, seconds: u64) -> Vec<(String, Vec<u8>)> {
    const HOOKS: &str = "<head><script>
        const post = (name, body) => fetch('/' + name, { method: 'POST', body });
        addEventListener('error', (e) => post('error', e.message));
        addEventListener('unhandledrejection', (e) => post('error', String(e.reason)));
        for (const kind of ['error', 'warn']) console[kind] = (...all) => post('error', all.join(' '));
    </script>";
    let script = format!(
        "<script>(async () => {{ {driver} }})()\
         .then(() => post('done', ''), (e) => post('error', String(e)).then(() => post('done', '')));</script></body>"
    );
    let page = page.replacen("<head>", HOOKS, 1).replacen("</body>", &script, 1);
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    server.set_nonblocking(true).unwrap();
    let profile = tempfile::tempdir().unwrap();
    let address = format!("http://{}/", server.local_addr().unwrap());
    let browser = command(program, profile.path())
        .args(["--window-size=900,700", &address])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the browser starts");
    let browser = Running(browser);
    let begun = Instant::now();
    let mut posted = Vec::new();
    loop {
        match server.accept() {
            Ok((stream, _)) => {
                stream.set_nonblocking(false).unwrap();
                stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
                if let Some((name, body)) = answer(stream, &page) {
                    if name == "done" {
                        break;
                    }
                    posted.push((name, body));
                }
            }
            Err(_) => std::thread::sleep(Duration::from_millis(5)),
        }
        assert!(begun.elapsed() < Duration::from_secs(seconds), "the page is not done after {seconds} s");
    }
    drop(browser);
    posted
}

/// Answers one request; what was posted.
fn answer(stream: TcpStream, page: &str) -> Option<(String, Vec<u8>)> {
    let mut reader = BufReader::new(stream);
    let mut first = String::new();
    reader.read_line(&mut first).ok()?;
    let mut length = 0;
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).ok()?;
        if line.trim().is_empty() {
            break;
        }
        if let Some(n) = line.to_ascii_lowercase().strip_prefix("content-length:") {
            length = n.trim().parse().ok()?;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).ok()?;
    let mut words = first.split_whitespace();
    let (method, path) = (words.next()?, words.next()?);
    let (status, text) = match (method, path) {
        ("POST", _) => ("200 OK", ""),
        ("GET", "/") => ("200 OK", page),
        _ => ("404 Not Found", ""),
    };
    let head = "Content-Type: text/html; charset=utf-8\r\nConnection: close";
    let mut stream = reader.into_inner();
    write!(stream, "HTTP/1.1 {status}\r\n{head}\r\nContent-Length: {}\r\n\r\n{text}", text.len()).ok()?;
    (method == "POST").then(|| (path.trim_start_matches('/').to_owned(), body))
}
