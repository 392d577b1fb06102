from setuptools import setup

NAME = "whereabouts_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="Publishes the pose of a camera, localized by a whereabouts server.",
    license="Apache-2.0",
    maintainer="whereabouts",
    maintainer_email="maintainers@whereabouts.invalid",
    py_modules=["localizer", "whereabouts_client", "whereabouts_node"],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools", "httpx>=0.22"],
    zip_safe=True,
    entry_points={"console_scripts": ["whereabouts_node = whereabouts_node:main"]},
)
