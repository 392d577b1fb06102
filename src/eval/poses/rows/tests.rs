//! Tables of poses as people have them.

use super::values::number;
use super::*;
use whereabouts_core::UtmZone;

fn rows(text: &str) -> anyhow::Result<PoseRows> {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    PoseRows::read(file.path())
}

fn error(text: &str) -> String {
    format!("{:#}", rows(text).unwrap_err())
}

#[test]
fn columns_have_the_names_that_people_give_them() {
    for header in [
        "file,lat,lon",
        "File,Lat,Lon",
        "image,latitude,longitude",
        "name,lat,lng",
        "filename,Latitude,Long",
        "SourceFile,GPSLatitude,GPSLongitude",
        "image_name,GPS Latitude,GPS Longitude",
        "path,lat_deg,lon_deg",
        "id,lat (deg),lon [°]",
    ] {
        let rows = rows(&format!("{header}\na.jpg,45.5,-30.25\n")).unwrap();
        let pose = rows.rows[0].place.unwrap().geographic.unwrap();
        assert_eq!((pose.lat, pose.lon), (45.5, -30.25), "{header}");
        assert!(rows.unused.is_empty(), "{header}: {:?}", rows.unused);
    }
    for header in ["file,x,y", "Label,Easting,Northing", "image,tx,ty", "file,X (m),Y (m)"] {
        let rows = rows(&format!("{header}\na.jpg,1,2\n")).unwrap();
        assert_eq!(
            rows.rows[0].place.unwrap().metric.map(|pose| (pose.x, pose.y)),
            Some((1.0, 2.0))
        );
    }
}

#[test]
fn numbers_may_have_decimal_commas_and_be_absent() {
    let text =
        "file;lat;lon;alt\na;45,5;\u{2212}30,25;\nb;;;\nc;nan;NaN;1\nd;45.5\u{b0};-30.25;7,5\n";
    let rows = rows(text).unwrap();
    let lat = |row: &PoseRow| row.place.and_then(|place| place.geographic).map(|pose| pose.lat);
    assert_eq!(rows.rows.iter().map(lat).collect::<Vec<_>>(), [Some(45.5), None, None, Some(45.5)]);
    assert_eq!(rows.rows[3].place.unwrap().geographic.unwrap().alt, Some(7.5));
    assert_eq!(number("1.234,5"), Err(()));
    assert_eq!(number("1,234,567"), Err(()));
}

#[test]
fn unknown_columns_are_named() {
    let rows = rows("frame,file,lat,lon,alt,yaw,z,\n7,a.jpg,45,-30,1,90,3,\n").unwrap();
    assert_eq!(rows.unused, ["frame", "yaw", "z"]);
    assert_eq!(rows.rows[0].name, "a.jpg");
}

#[test]
fn an_invalid_row_is_reported_with_its_line() {
    for text in [
        "file,lat,lon\na,1,2\nb,95,2",
        "file,x,y\na,1,2\nb,,2",
        "file,x,y\na,1,2\nb,q,2",
        "file,lat,lon\n\n,1,2",
        "file,lat,lon\na,1,2\nb,1",
        "file,lat,lon,heading\n# one\na,1,2,720",
        "file,x,y,zone\na,1,2,10S\nb,1,2,ten",
    ] {
        assert!(error(text).contains("line 3"), "{}", error(text));
    }
    assert!(error("file,lat,lon\n").contains("no rows"));
    assert!(error("a.jpg,45,-30\n").contains("no column that names the files"));
    assert!(error("file,lat\na,1\n").contains("lat and lon, or x and y"));
    assert!(error("file,lat,lon,x,y\na,1,2,,\nb,,,1,2\n").contains("mixes"));
}

#[test]
fn two_rows_may_not_give_one_file_different_poses() {
    let text = error("file,lat,lon\na.jpg,45,-30\nb.jpg,45,-30\n./a.jpg,46,-31\n");
    assert!(text.contains("lines 2 and 4") && text.contains("a.jpg"), "{text}");
    let same = rows("file,lat,lon\na.jpg,45,-30\na.jpg,45.0,-30.0\n").unwrap();
    assert_eq!((same.rows.len(), same.repeated), (1, 1));
}

#[test]
fn a_zone_makes_metres_a_place_on_the_globe() {
    for text in [
        "file,easting,northing,zone\na,543250.96,4178900.7,10S",
        "file,x,y,utm_zone,band\na,543250.96,4178900.7,10,S",
    ] {
        assert_eq!(
            rows(text).unwrap().rows[0].place.unwrap().zone,
            UtmZone::new(10, false),
            "{text}"
        );
    }
}

#[test]
fn coordinates_are_read_as_exiftool_and_people_write_them() {
    let (lat, lon) = (45.0 + 12.0 / 60.0 + 30.0 / 3600.0, -30.0 - 1.0 / 3600.0);
    let west = "30 deg 0' 1.00\" W";
    for (text, expected) in [
        ("45 deg 12' 30.00\" N", lat),
        ("45 deg 12' 30,00\" N", lat),
        ("45 deg 12.5' N", lat),
        ("45\u{b0}12'30\"N", lat),
        ("45\u{b0} 12\u{2032} 30\u{2033} N", lat),
        ("45\u{ba} 12\u{2019} 30\u{201d} n", lat),
        ("N 45\u{b0} 12.5'", lat),
        ("north 45:12:30", lat),
        ("45 12 30 S", -lat),
        ("45,12,30N", lat),
        ("45,12.5N", lat),
        ("45.208333333 N", lat),
        ("45,208333333 N", lat),
        ("-45 deg 12' 30\"", -lat),
        ("-45\u{b0}12'30\" S", -lat),
        ("45 deg 11' 60.00\" N", 45.2),
        ("+45.5", 45.5),
        ("45.5 deg", 45.5),
        ("45,5", 45.5),
        ("4.55e1", 45.5),
    ] {
        let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
        let rows = rows(&format!(
            "SourceFile,GPSLatitude,GPSLongitude\na,{},{}",
            quoted(text),
            quoted(west)
        ));
        let pose = rows.unwrap().rows[0].place.unwrap().geographic.unwrap();
        assert!(
            (pose.lat - expected).abs() < 1e-8 && (pose.lon - lon).abs() < 1e-8,
            "{text}: {pose:?}"
        );
    }
    for text in [
        "45 deg 12' 30.00\"",
        "45 12 30",
        "45,12,30",
        "45,30N",
        "45.5 E",
        "N 45 N",
        "45 deg 61' N",
        "45.5 12 N",
        "1 2 3 4 N",
        "--45 N",
        "45 deg -12' N",
        "45x",
        "N",
        "deg",
        "1.234,5",
        "95 deg 0' 0\" N",
    ] {
        let text = error(&format!("file;lat;lon\na;1;2\nb;{text};2\n"));
        assert!(text.contains("line 3"), "{text}");
    }
    assert!(error("file;lat;lon\na;45 12 30;2\n").contains("has no hemisphere"));
}

#[test]
fn hemispheres_and_references_may_have_columns_of_their_own() {
    let header = "SourceFile;GPSLatitude;GPSLatitudeRef;GPSLongitude;GPSLongitudeRef;GPSAltitude;GPSAltitudeRef";
    let one = |row: &str| {
        let rows = rows(&format!("{header}\na;{row}\n")).unwrap();
        assert!(rows.unused.is_empty(), "{:?}", rows.unused);
        let pose = rows.rows[0].place.unwrap().geographic.unwrap();
        (pose.lat, pose.lon, pose.alt)
    };
    assert_eq!(
        one("45 deg 30' 0.00\";South;30 deg 15';West;240.5 m;Below Sea Level"),
        (-45.5, -30.25, Some(-240.5))
    );
    assert_eq!(one("45.5;S;30.25;E;240.5 m Above Sea Level;"), (-45.5, 30.25, Some(240.5)));
    assert_eq!(one("45.5;North;-30.25;W;240.5;1"), (45.5, -30.25, Some(-240.5)));
    assert_eq!(one("45.5;;-30.25;;240 m Below Sea Level;0"), (45.5, -30.25, Some(-240.0)));
    assert_eq!(one("45.5;;-30.25;;undef;"), (45.5, -30.25, None));
    for row in ["-45.5;N;1;E;;", "45.5 N;S;1;E;;", "45.5;N;1;E;90 ft;"] {
        let text = error(&format!("{header}\na;{row}\n"));
        assert!(text.contains("line 2"), "{text}");
    }
}

#[test]
fn a_latitude_and_a_longitude_may_share_a_cell() {
    for (header, cell) in [
        ("GPSPosition", "45 deg 30' 0.00\" N, 30 deg 15' 0.00\" W"),
        ("GPSPosition", "45.5 -30.25"),
        ("lat,lon", "45.5,-30.25"),
        ("coordinates", "(45.5, -30.25)"),
        ("latlng", "45,5; -30,25"),
        ("latlng", "45,5, -30,25"),
    ] {
        let rows =
            rows(&format!("file|{header}\na|\"{}\"\nb|\n", cell.replace('"', "\"\""))).unwrap();
        let pose = rows.rows[0].place.unwrap().geographic.unwrap();
        assert_eq!((pose.lat, pose.lon), (45.5, -30.25), "{cell}");
        assert_eq!(rows.rows[1].place, None);
    }
    assert!(error("file|latlon\na|45\n").contains("line 2"));
}

#[test]
fn zones_are_read_in_every_notation_and_never_guessed() {
    let zone = |row: &str| {
        let rows = rows(&format!("file;x;y;zone;hemisphere;lat;lon\na;{row}\n"))?;
        anyhow::Ok((
            rows.rows[0].place.unwrap().zone.map(|zone| zone.to_string()),
            rows.notes.len(),
        ))
    };
    for (row, expected) in [
        ("391000;5820000;33U;;;", "33 north"),
        ("391000;5820000;33 North;;;", "33 north"),
        ("391000;5820000;33;N;;", "33 north"),
        ("391000;5820000;33.0;south;;", "33 south"),
        ("391000;4178900;33;S;;", "33 south"),
        ("391000;4178900;33S;;;", "33 north"),
        ("391000;5820000;EPSG:32633;;;", "33 north"),
        ("391000;5820000;32733;;;", "33 south"),
        ("391000;5820000;33;;52.5;13.4", "33 north"),
        ("391000;5820000;33;;-37.7;13.4", "33 south"),
    ] {
        assert_eq!(zone(row).unwrap(), (Some(expected.to_owned()), 0), "{row}");
    }
    assert_eq!(zone("391000;5820000;33;;;").unwrap(), (None, 1));
    assert_eq!(zone("391000;5820000;;;;").unwrap(), (None, 0));
    for row in [
        "391000;5820000;33K;;;",
        "391000;5820000;33U;;-37.7;13.4",
        "391000;5820000;61N;;;",
        "1;2;32661;;;",
    ] {
        assert!(format!("{:#}", zone(row).unwrap_err()).contains("line 2"), "{row}");
    }
    let text = error("file,x,y,zone\na,1,2,32\nb,1,2,33\n");
    assert!(text.contains("32 in line 2 and 33 in line 3"), "{text}");
}

#[test]
fn rows_at_zero_degrees_are_counted() {
    let rows = rows("file,lat,lon\na,0,0\nb,0,0\nc,0,1\n").unwrap();
    assert!(rows.notes[0].contains("(2)"), "{:?}", rows.notes);
}
