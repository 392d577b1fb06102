//! Tables of poses as people have them.

use super::*;

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
