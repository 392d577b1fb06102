//! Where a message may go. A webhook must not be a way into the network that the server stands in.
//!
//! What is no public address is refused where the webhook is made, if the URL has the address itself in it,
//! and in any case when it is connected to: the name is looked up here, and what is connected to is one
//! of the addresses that were found good, so that a name that changes its address in between is of no use.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use reqwest::Url;
use reqwest::dns::{Addrs, Name, Resolve, Resolving};

/// The longest URL, in bytes.
const MOST_BYTES: usize = 2048;

/// The URL that a text is, if a webhook may have it; else what is wrong with it.
pub(super) fn parse(text: &str, allow_private: bool) -> Result<Url, String> {
    if text.len() > MOST_BYTES {
        return Err(format!("the url has {} bytes; it may have {MOST_BYTES}", text.len()));
    }
    let url = Url::parse(text).map_err(|error| format!("the url cannot be read: {error}"))?;
    if !matches!(url.scheme(), "http" | "https") {
        return Err("the url must begin with https:// or http://".into());
    }
    if !url.username().is_empty() || url.password().is_some() {
        return Err("the url must have no user and no password in it; messages are signed".into());
    }
    if url.fragment().is_some() {
        return Err("the url must have no fragment (#…)".into());
    }
    check(&url, allow_private)?;
    Ok(url)
}

/// Refuses a URL that says itself that it leads to an address that is not public.
pub(super) fn check(url: &Url, allow_private: bool) -> Result<(), String> {
    let host = url.host_str().unwrap_or_default();
    if allow_private {
        return Ok(());
    }
    let name = host.trim_end_matches('.');
    if name == "localhost" || name.ends_with(".localhost") {
        return Err(refusal(host, "this machine"));
    }
    // An address of version 6 stands in brackets. One of version 4 has been brought to four decimal
    // numbers, however it was written.
    match host.trim_start_matches('[').trim_end_matches(']').parse().map(not_public) {
        Ok(Some(what)) => Err(refusal(host, what)),
        _ => Ok(()),
    }
}

fn refusal(host: &str, what: &str) -> String {
    format!(
        "{host} is {what}, and messages go to public addresses only; choose another url, or let the \
         operator of the server allow it with webhooks.allow_private"
    )
}

/// Looks names up, and leaves out what is not public.
pub(super) struct PublicOnly {
    pub allow_private: bool,
}

impl Resolve for PublicOnly {
    fn resolve(&self, name: Name) -> Resolving {
        let allow_private = self.allow_private;
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let (mut good, mut refused) = (Vec::<SocketAddr>::new(), None);
            for address in found {
                match not_public(address.ip()).filter(|_| !allow_private) {
                    None => good.push(address),
                    Some(what) => refused = Some((address.ip(), what)),
                }
            }
            match refused {
                Some((ip, what)) if good.is_empty() => {
                    Err(refusal(&format!("{} has the address {ip}, which", name.as_str()), what)
                        .into())
                }
                _ => Ok(Box::new(good.into_iter()) as Addrs),
            }
        })
    }
}

/// What an address is that is not public.
fn not_public(address: IpAddr) -> Option<&'static str> {
    match address {
        IpAddr::V4(address) => v4_not_public(address),
        IpAddr::V6(address) => v6_not_public(address),
    }
}

/// The IANA registry of special-purpose addresses (RFC 6890), without what is globally reachable.
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

/// What is not public though it is within 2000::/3.
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
        // Mapped (RFC 4291), NAT64 (RFC 6052) and 6to4 (RFC 3056): what counts is the address in it.
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
    fn only_public_addresses_are_good() {
        let refused = "0.0.0.0 0.1.2.3 10.0.0.1 100.64.0.1 100.127.255.255 127.0.0.1 127.255.255.254 \
                    169.254.169.254 172.16.0.1 172.31.255.255 192.0.0.192 192.0.2.1 192.88.99.1 \
                    192.168.1.1 198.18.0.1 198.19.255.255 198.51.100.7 203.0.113.9 224.0.0.1 \
                    239.255.255.255 240.0.0.1 255.255.255.255 :: ::1 ::7f00:1 ::ffff:127.0.0.1 \
                    ::ffff:10.1.2.3 ::ffff:0:127.0.0.1 64:ff9b::10.0.0.1 64:ff9b::a9fe:a9fe 64:ff9b:1::1 \
                    100::1 2001::1 2001:2::1 2001:10::1 2001:20::1 2001:db8::1 2002:7f00:1:: \
                    2002:c0a8:101::1 3fff::1 5f00::1 fc00::1 fd12:3456::1 fe80::1 febf::1 fec0::1 \
                    ff02::1 4000::1";
        for address in refused.split_whitespace() {
            assert!(not_public(address.parse().unwrap()).is_some(), "{address}");
        }
        let good = "1.1.1.1 8.8.8.8 9.255.255.255 11.0.0.1 100.63.255.255 100.128.0.0 126.0.0.1 \
                    128.0.0.1 169.253.0.1 172.15.0.1 172.32.0.1 192.0.1.1 192.167.0.1 198.17.0.1 \
                    198.20.0.1 223.255.255.255 ::ffff:8.8.8.8 64:ff9b::8.8.8.8 2002:808:808::1 \
                    2606:4700:4700::1111 2a00:1450::1 2001:200::1 2001:4860:4860::8888";
        for address in good.split_whitespace() {
            assert_eq!(not_public(address.parse().unwrap()), None, "{address}");
        }
    }

    #[test]
    fn an_address_is_seen_through_however_it_is_written() {
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
    fn a_url_is_one_of_the_web_without_credentials_and_fragment() {
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
        let long = format!("https://example.com/{}", "x".repeat(MOST_BYTES));
        assert!(parse(&long, false).unwrap_err().contains("2048"));
        for url in ["https://example.com/a?b=c", "http://8.8.8.8:8080/", "https://[2606:4700::1]/"]
        {
            assert_eq!(parse(url, false).unwrap().as_str(), url);
        }
    }

    #[tokio::test]
    async fn a_name_that_leads_to_this_machine_is_not_looked_up_to_the_end() {
        let looked_up = |allow_private| async move {
            PublicOnly { allow_private }.resolve("localhost".parse().unwrap()).await
        };
        let Err(refused) = looked_up(false).await else { panic!("it was resolved") };
        assert!(refused.to_string().contains("webhooks.allow_private"), "{refused}");
        assert!(looked_up(true).await.unwrap().all(|address| address.ip().is_loopback()));
    }
}
