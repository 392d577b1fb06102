//! Which addresses a message may be sent to. A webhook must not be a way into the server's own network (SSRF).
//!
//! A URL with a non-public address is rejected when the webhook is created. A host name is resolved here when
//! it is connected to, and only its public addresses are used, so that changing the name's address in between
//! (DNS rebinding) does not help.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use reqwest::Url;
use reqwest::dns::{Addrs, Name, Resolve, Resolving};

/// Maximum length of a URL, in bytes.
const MAX_URL_BYTES: usize = 2048;

/// Parses the URL of a webhook.
///
/// # Errors
/// What is wrong with the URL, for the caller.
pub(super) fn parse(text: &str, allow_private: bool) -> Result<Url, String> {
    if text.len() > MAX_URL_BYTES {
        return Err(format!("the url has {} bytes; the maximum is {MAX_URL_BYTES}", text.len()));
    }
    let url = Url::parse(text).map_err(|error| format!("the url cannot be read: {error}"))?;
    if !matches!(url.scheme(), "http" | "https") {
        return Err("the url must begin with https:// or http://".into());
    }
    if !url.username().is_empty() || url.password().is_some() {
        return Err(
            "the url must contain no user and no password; messages are signed instead".into()
        );
    }
    if url.fragment().is_some() {
        return Err("the url must have no fragment (#…)".into());
    }
    check(&url, allow_private)?;
    Ok(url)
}

/// Rejects a URL that contains a non-public address itself.
pub(super) fn check(url: &Url, allow_private: bool) -> Result<(), String> {
    let host = url.host_str().unwrap_or_default();
    if allow_private {
        return Ok(());
    }
    let name = host.trim_end_matches('.');
    if name == "localhost" || name.ends_with(".localhost") {
        return Err(rejection(host, "this machine"));
    }
    // An IPv6 address is in brackets. The URL parser has normalised an IPv4 address to four decimal numbers,
    // however it was written.
    match host.trim_start_matches('[').trim_end_matches(']').parse().map(not_public) {
        Ok(Some(what)) => Err(rejection(host, what)),
        _ => Ok(()),
    }
}

fn rejection(host: &str, what: &str) -> String {
    format!(
        "{host} is {what}, and messages are sent to public addresses only; choose another url, or ask \
         the operator of the server to set webhooks.allow_private"
    )
}

/// Resolves host names to their public addresses.
pub(super) struct PublicOnly {
    pub allow_private: bool,
}

impl Resolve for PublicOnly {
    fn resolve(&self, name: Name) -> Resolving {
        let allow_private = self.allow_private;
        Box::pin(async move {
            let addresses = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let (mut public, mut rejected) = (Vec::<SocketAddr>::new(), None);
            for address in addresses {
                match not_public(address.ip()).filter(|_| !allow_private) {
                    None => public.push(address),
                    Some(what) => rejected = Some((address.ip(), what)),
                }
            }
            match rejected {
                Some((ip, what)) if public.is_empty() => {
                    Err(rejection(&format!("{} has the address {ip}, which", name.as_str()), what)
                        .into())
                }
                _ => Ok(Box::new(public.into_iter()) as Addrs),
            }
        })
    }
}

/// Describes an address that is not public; `None` for a public one.
fn not_public(address: IpAddr) -> Option<&'static str> {
    match address {
        IpAddr::V4(address) => v4_not_public(address),
        IpAddr::V6(address) => v6_not_public(address),
    }
}

/// The IANA registry of special-purpose addresses (RFC 6890), without those that are globally reachable.
const V4: [([u8; 4], u32, &str); 16] = [
    ([0, 0, 0, 0], 8, "unspecified"),
    ([10, 0, 0, 0], 8, "private"),
    ([100, 64, 0, 0], 10, "shared by a carrier"),
    ([127, 0, 0, 0], 8, "this machine"),
    ([169, 254, 0, 0], 16, "link-local"),
    ([172, 16, 0, 0], 12, "private"),
    ([192, 0, 0, 0], 24, "reserved"),
    ([192, 0, 2, 0], 24, "for documentation"),
    ([192, 88, 99, 0], 24, "reserved"),
    ([192, 168, 0, 0], 16, "private"),
    ([198, 18, 0, 0], 15, "for benchmarks"),
    ([198, 51, 100, 0], 24, "for documentation"),
    ([203, 0, 113, 0], 24, "for documentation"),
    ([224, 0, 0, 0], 4, "multicast"),
    ([255, 255, 255, 255], 32, "broadcast"),
    ([240, 0, 0, 0], 4, "reserved"),
];

fn v4_not_public(address: Ipv4Addr) -> Option<&'static str> {
    let within = |net: [u8; 4], bits: u32| {
        (u32::from_be_bytes(net) ^ address.to_bits()).leading_zeros() >= bits
    };
    V4.iter().find(|(net, bits, _)| within(*net, *bits)).map(|(_, _, what)| *what)
}

/// Non-public networks within 2000::/3, the range of global unicast.
const V6: [([u16; 2], u32, &str); 3] = [
    // Teredo, benchmarks, ORCHID and other protocols.
    ([0x2001, 0], 23, "reserved"),
    ([0x2001, 0xdb8], 32, "for documentation"),
    ([0x3fff, 0], 20, "for documentation"),
];

fn v6_not_public(address: Ipv6Addr) -> Option<&'static str> {
    let (bits, segments) = (address.to_bits(), address.segments());
    let embedded = |shift: u32| v4_not_public(Ipv4Addr::from_bits((bits >> shift) as u32));
    match segments {
        [0, 0, 0, 0, 0, 0, 0, 0] => Some("unspecified"),
        [0, 0, 0, 0, 0, 0, 0, 1] => Some("this machine"),
        // Mapped (RFC 4291), NAT64 (RFC 6052) and 6to4 (RFC 3056): the embedded IPv4 address decides.
        [0, 0, 0, 0, 0, 0xffff, _, _] | [0x64, 0xff9b, 0, 0, 0, 0, _, _] => embedded(0),
        [0x2002, ..] => embedded(80),
        [0xfc00..=0xfdff, ..] => Some("private"),
        [0xfe80..=0xfebf, ..] => Some("link-local"),
        [0xff00..=0xffff, ..] => Some("multicast"),
        [0x2000..=0x3fff, second, ..] => {
            let start = u32::from(segments[0]) << 16 | u32::from(second);
            let within = |net: [u16; 2], bits: u32| {
                let net = u32::from(net[0]) << 16 | u32::from(net[1]);
                (net ^ start).leading_zeros() >= bits
            };
            V6.iter().find(|(net, bits, _)| within(*net, *bits)).map(|(_, _, what)| *what)
        }
        _ => Some("reserved"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_public_addresses_are_allowed() {
        let non_public = "0.0.0.0 0.1.2.3 10.0.0.1 100.64.0.1 100.127.255.255 127.0.0.1 127.255.255.254 \
                    169.254.169.254 172.16.0.1 172.31.255.255 192.0.0.192 192.0.2.1 192.88.99.1 \
                    192.168.1.1 198.18.0.1 198.19.255.255 198.51.100.7 203.0.113.9 224.0.0.1 \
                    239.255.255.255 240.0.0.1 255.255.255.255 :: ::1 ::7f00:1 ::ffff:127.0.0.1 \
                    ::ffff:10.1.2.3 ::ffff:0:127.0.0.1 64:ff9b::10.0.0.1 64:ff9b::a9fe:a9fe 64:ff9b:1::1 \
                    100::1 2001::1 2001:2::1 2001:10::1 2001:20::1 2001:db8::1 2002:7f00:1:: \
                    2002:c0a8:101::1 3fff::1 5f00::1 fc00::1 fd12:3456::1 fe80::1 febf::1 fec0::1 \
                    ff02::1 4000::1";
        for address in non_public.split_whitespace() {
            assert!(not_public(address.parse().unwrap()).is_some(), "{address}");
        }
        let public = "1.1.1.1 8.8.8.8 9.255.255.255 11.0.0.1 100.63.255.255 100.128.0.0 126.0.0.1 \
                    128.0.0.1 169.253.0.1 172.15.0.1 172.32.0.1 192.0.1.1 192.167.0.1 198.17.0.1 \
                    198.20.0.1 223.255.255.255 ::ffff:8.8.8.8 64:ff9b::8.8.8.8 2002:808:808::1 \
                    2606:4700:4700::1111 2a00:1450::1 2001:200::1 2001:4860:4860::8888";
        for address in public.split_whitespace() {
            assert_eq!(not_public(address.parse().unwrap()), None, "{address}");
        }
    }

    #[test]
    fn a_private_address_is_recognised_in_any_notation() {
        let private = "http://127.0.0.1/ http://127.1/ http://2130706433/ http://0x7f000001/ http://0x7f.1/ \
                    http://0177.0.0.1/ http://017700000001/ http://127.0.0.1./ http://0/ \
                    http://%31%32%37.0.0.1/ http://１２７.0.0.1/ http://127。0。0。1/ http://localhost/ \
                    http://LOCALHOST:80/ http://localhost./ http://a.localhost/ http://[::1]/ \
                    http://[::ffff:127.0.0.1]/ http://[::ffff:7f00:1]/ http://[::]/ \
                    https://169.254.169.254/latest/meta-data https://0xa9fea9fe/ \
                    https://192.168.0.1:8443/x https://[fe80::1]/ https://[fd00::1]:8080/ \
                    http:\\\\127.0.0.1\\x http:127.0.0.1";
        for url in private.split_whitespace() {
            let refused = parse(url, false).unwrap_err();
            assert!(refused.contains("webhooks.allow_private"), "{url}: {refused}");
            parse(url, true).unwrap();
        }
    }

    #[test]
    fn a_url_must_be_http_without_credentials_and_fragment() {
        for (url, why) in [
            ("", "cannot be read"),
            ("nonsense", "cannot be read"),
            ("https://", "cannot be read"),
            ("https://[fe80::1%25eth0]/", "cannot be read"),
            ("http://256.256.256.256/", "cannot be read"),
            ("ftp://example.com/", "begin with"),
            ("file:///etc/passwd", "begin with"),
            ("gopher://example.com/", "begin with"),
            ("https://user@example.com/", "no user"),
            ("https://:password@example.com/", "no user"),
            ("https://example.com/#part", "fragment"),
        ] {
            for allow_private in [false, true] {
                let refused = parse(url, allow_private).unwrap_err();
                assert!(refused.contains(why), "{url}: {refused}");
            }
        }
        let long = format!("https://example.com/{}", "x".repeat(MAX_URL_BYTES));
        assert!(parse(&long, false).unwrap_err().contains("2048"));
        for url in ["https://example.com/a?b=c", "http://8.8.8.8:8080/", "https://[2606:4700::1]/"]
        {
            assert_eq!(parse(url, false).unwrap().as_str(), url);
        }
    }

    #[tokio::test]
    async fn a_host_name_that_resolves_to_this_machine_is_rejected() {
        let resolve = |allow_private| async move {
            PublicOnly { allow_private }.resolve("localhost".parse().unwrap()).await
        };
        let Err(refused) = resolve(false).await else { panic!("it was resolved") };
        assert!(refused.to_string().contains("webhooks.allow_private"), "{refused}");
        assert!(resolve(true).await.unwrap().all(|address| address.ip().is_loopback()));
    }
}
